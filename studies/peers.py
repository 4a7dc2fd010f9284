"""Speed beside other packages, and the parts of a step, for docs/guide/speed.md: ``python -m studies.peers``.

``studies.perf`` measures bufgym alone. This adds CartPole of other packages, as far as they are installed, and says how
the time of a step divides.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version
from typing import Any

import gymnasium as gym
import numpy as np

from bufgym.envs.output import StepOutput, write_mask, write_observation
from bufgym.jit import kernel
from bufgym.sim.state import NOTHING_WAITS, Batch
from studies.perf import ENVIRONMENTS, NATIVE, SEED, TOPICS, Measurement, Sizes, best_s, measure, play, record, report

PEERS = {
    "gymnasium": f"gym.make_vec('CartPole-v1', vectorization_mode='{NATIVE}'), in numpy",
    "envpool": "envpool.make('CartPole-v1', num_threads=1), in C++",
    "pufferlib": "pufferlib.ocean's Cartpole, in C",
}
"""Other packages' batches of CartPole, the smallest task that every package has."""


def _peer(package: str, n: int) -> Any:
    """``n`` CartPoles with ``reset()``, ``step(actions)`` and ``close()``."""
    if package == "gymnasium":
        return gym.make_vec("CartPole-v1", n, vectorization_mode=NATIVE)
    if package == "envpool":
        return importlib.import_module(package).make("CartPole-v1", env_type="gymnasium", num_envs=n, num_threads=1)
    return importlib.import_module("pufferlib.ocean.cartpole.cartpole").Cartpole(num_envs=n)


def measure_peers(sizes: Sizes, figures: Sequence[Measurement]) -> tuple[list[Measurement], list[str]]:
    """(speeds of the PEERS and ratios of the native batches among ``figures`` to them; packages not here, and why)."""
    n = max(sizes.batches)
    ours = [figure for figure in figures if figure.name in [f"native batch, {id}, n = {n}" for id in ENVIRONMENTS]]
    actions = np.random.default_rng(SEED).integers(2, size=(sizes.steps(n), n)).astype(np.int32)
    found, absent = [], []
    for package, call in PEERS.items():
        try:
            envs = _peer(package, n)
        except (ImportError, OSError) as error:
            absent.append(f"{package} ({error})")
            continue
        rate = actions.size / best_s(sizes.repeats, envs.reset, partial(play, envs, actions))
        envs.close()
        call += f", {package} {version(package)}, n = {n}, random actions, resets in the time"
        found.append(Measurement(f"CartPole, {package}", rate, "steps/s", None, f"steps a second of {call}"))
        ratios = [(f"{figure.name} / {package}", figure.value / rate) for figure in ours]
        found += [Measurement(name, ratio, "times", None, "the ratio of these two") for name, ratio in ratios]
    return found, absent


@kernel
def _observe_all(batch: Batch, output: StepOutput) -> None:
    """Every row's observation and mask."""
    for i in range(len(batch.senders)):
        write_observation(batch, i, False, output, None)


@kernel
def _mask_all(batch: Batch, output: StepOutput) -> None:
    """Every row's mask."""
    for i in range(len(batch.senders)):
        if batch.senders[i].waiting != NOTHING_WAITS:
            write_mask(batch, i, output.action_mask)


def _parts_s(repeats: int, owner: Any, names: Sequence[str], reset: Any, play: Any) -> list[float]:
    """Seconds of the best repeat of ``play``: the whole, then the time inside each of ``owner``'s methods ``names``."""
    seconds = dict.fromkeys(names, 0.0)

    def timed(name: str, method: Callable[..., Any], *arguments: Any) -> Any:
        begin = time.perf_counter()
        result = method(*arguments)
        seconds[name] += time.perf_counter() - begin
        return result

    def begin() -> None:
        reset(seed=SEED)
        seconds.update(dict.fromkeys(names, 0.0))

    for name in names:
        setattr(owner, name, partial(timed, name, getattr(owner, name)))
    return min([best_s(1, begin, play), *seconds.values()] for _ in range(repeats))


def _shares(of: str, whole: float, parts: dict[str, float]) -> str:
    return "\n".join([of, *(f"  {name:<45} {ns:8.0f} ns {ns / whole:6.0%}" for name, ns in parts.items())])


def profile(sizes: Sizes) -> str:
    """Where the time of a step goes, as tables: native batches, then the single environment.

    Kernels that write are timed alone, over the batch as it stands after a while. The transition is the remainder.
    """
    batches = [_profile_batch(id, sizes.capacity, sizes) for id in ENVIRONMENTS]
    tables = [*batches, _profile_batch(TOPICS, sizes.topic_slots, sizes), _profile_single("bufgym/Uplink-v1", sizes)]
    return "\n\n".join(tables)


def _profile_batch(id: str, capacity: int, sizes: Sizes) -> str:
    n = max(sizes.batches)
    vector: Any = gym.make_vec(id, n, vectorization_mode=NATIVE, capacity=capacity)
    actions, decisions = record(vector, sizes.steps(n))
    sub_envs = vector.unwrapped.sub_envs
    best = _parts_s(sizes.repeats, sub_envs, ("step", "reset"), vector.reset, lambda: play(vector, actions))
    whole, in_kernel, in_reset = (seconds / decisions * 1e9 for seconds in best)
    batch, output = sub_envs.senders.batch, sub_envs.output
    asks = max(1, int((batch.senders["waiting"] != NOTHING_WAITS).sum()))

    def written(kernel: Callable[..., None]) -> float:
        """ns a decision, of 20 passes."""

        def passes(count: int = 20) -> None:
            for _ in range(count):
                kernel(batch, output)

        passes(1)
        return best_s(sizes.repeats * 20, lambda: None, passes) / 20 / asks * 1e9

    masks = written(_mask_all)
    fields = written(_observe_all) - masks
    vector.close()
    parts = {
        f"observation ({output.flat.shape[1]} numbers)": fields,
        "action mask": masks,
        "decision, transition, rewards": in_kernel - fields - masks,
        "episodes drawn and begun": in_reset,
        "Python around the kernel": whole - in_kernel - in_reset,
    }
    return _shares(f"native batch of {n}, {id}, L = {capacity}", whole, parts)


def _profile_single(id: str, sizes: Sizes) -> str:
    env: Any = gym.make(id, capacity=sizes.capacity).unwrapped
    reject, sub_envs, names = sizes.capacity, env.sub_envs, ("step", "observation", "info", "reset")
    game = partial(play, env, [reject] * sizes.single_steps, True)
    best = _parts_s(sizes.repeats, sub_envs, names, env.reset, game)
    whole, stepping, observing, informing, beginning = (seconds / sizes.single_steps * 1e9 for seconds in best)
    parts = {
        "handing the kernel its arrays, and the kernel": stepping,
        "the observation's dict of views": observing,
        "info": informing,
        "episodes drawn and begun": beginning,
        "the rest of Env.step, in Python": whole - stepping - observing - informing - beginning,
    }
    return _shares(f"single environment, {id}, L = {sizes.capacity}", whole, parts)


def main() -> None:
    """Print the speeds, and the parts of a step."""
    sizes = Sizes()
    figures = measure(sizes)
    peers, absent = measure_peers(sizes, figures)
    print(report([*figures, *peers], sizes.repeats))
    if absent:
        print(f"Not here, so left out: {', '.join(absent)}")
    print(f"\n{profile(sizes)}")


if __name__ == "__main__":
    main()
