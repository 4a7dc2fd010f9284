"""Other packages' batches in the same run as bufgym's own: only ratios within a run are worth quoting.

The task is CartPole, the smallest that every package has: a few numbers of state and none of a queue's decisions.
Nothing is installed for this; a package that is not here is named and left out.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import numpy as np

from bufgym.benchmark.perf import ENVIRONMENTS, SEED, Figure, Sizes, best_s


@dataclass(frozen=True)
class Peer:
    """A batch of CartPole of another package."""

    package: str
    call: str
    """What makes it, as a definition says it."""
    make: Callable[[int], Any]
    """(number of environments) -> something with ``reset()``, ``step(actions)`` and ``close()``."""


def _gymnasium(n: int) -> Any:
    return gym.make_vec("CartPole-v1", n, vectorization_mode="vector_entry_point")


def _envpool(n: int) -> Any:
    envpool = importlib.import_module("envpool")
    return envpool.make("CartPole-v1", env_type="gymnasium", num_envs=n, num_threads=1)


def _pufferlib(n: int) -> Any:
    return importlib.import_module("pufferlib.ocean.cartpole.cartpole").Cartpole(num_envs=n)


PEERS = (
    Peer("gymnasium", "gym.make_vec('CartPole-v1', vectorization_mode='vector_entry_point'), in numpy", _gymnasium),
    Peer("envpool", "envpool.make('CartPole-v1', num_threads=1), in C++", _envpool),
    Peer("pufferlib", "pufferlib.ocean's Cartpole, in C", _pufferlib),
)


def measure(sizes: Sizes, figures: Sequence[Figure], peers: Sequence[Peer] = PEERS) -> tuple[list[Figure], list[str]]:
    """(each peer's speed, and that of bufgym's native batches among ``figures`` over it; the packages left out)."""
    ours = [figure for figure in figures if figure.name in [f"native batch, {id}" for id in ENVIRONMENTS]]
    found, absent = [], []
    for peer in peers:
        if importlib.util.find_spec(peer.package) is None:
            absent.append(peer.package)
            continue
        try:
            envs = peer.make(sizes.batch)
        except (ImportError, OSError) as error:  # installed without what it needs
            absent.append(f"{peer.package} ({error})")
            continue
        rate = _rate(envs, sizes)
        of = f"{peer.package} {version(peer.package)}"
        definition = f"steps a second of {peer.call}, {of}, n = {sizes.batch}, random actions, resets in the time"
        found.append(Figure(f"CartPole, {peer.package}", rate, "steps/s", None, definition))
        found += [
            Figure(f"{f.name} / {peer.package}", f.value / rate, "times", None, "the ratio of these two") for f in ours
        ]
    return found, absent


def _rate(envs: Any, sizes: Sizes) -> float:
    """Steps of single environments a second."""
    rng = np.random.default_rng(SEED)
    actions = rng.integers(2, size=(sizes.steps, sizes.batch)).astype(np.int32)

    def play() -> None:
        for row in actions:
            envs.step(row)

    try:
        return actions.size / best_s(sizes.repeats, envs.reset, play)
    finally:
        envs.close()
