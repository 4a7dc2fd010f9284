"""bufgym's own speed: its environments and its rollouts.

Every figure is the best of several repeats, because other work on the machine can only slow a repeat down. Everything
runs in one thread. Actions are drawn beforehand, uniform among the valid ones, by playing the same seeded episodes
once. So the timed loop holds only the environment's own work and its resets.
"""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from bufgym import policies
from bufgym import scenario as scenarios
from bufgym.benchmark.run import draw
from bufgym.benchmark.table import Table
from bufgym.ground.files import replaced
from bufgym.ground.kernel import JIT, compile_here
from bufgym.sim import Senders

ENVIRONMENTS = {"bufgym/Uplink-v0": 10e6, "bufgym/Interruption-v0": 8e6}
"""Decisions a second that their native batches aim at."""
TOPICS = "bufgym/Topics-v0"
POLICIES = ("afr", "drop-oldest", "random", "min-gap")
NATIVE = "vector_entry_point"
SEED = 1


class Measurement(NamedTuple):
    """One measured figure. ``value`` and ``target`` are in ``unit``; ``definition`` says how it was measured."""

    name: str
    value: float
    unit: str
    target: float | None
    definition: str


@dataclass(frozen=True)
class Sizes:
    """How much is measured. The defaults take about half a minute."""

    capacity: int = 16  # L, messages
    batch: int = 1024  # environments in a batch
    steps: int = 1000  # of the native batch
    sync_steps: int = 30  # of Gymnasium's SyncVectorEnv
    single_steps: int = 20_000  # of the single environment
    episodes: int = 1000  # of a fixed-policy rollout
    repeats: int = 3  # of each figure; the best one counts
    topic_slots: int = 32  # L of the batch with several topics


def best_s(repeats: int, prepare: Callable[[], Any], work: Callable[[], Any]) -> float:
    """Shortest time of ``work`` over the repeats, s. ``prepare`` runs before each, untimed."""
    times = []
    for _ in range(repeats):
        prepare()
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return min(times)


def play(env: Any, actions: Iterable[Any], single: bool = False) -> None:
    """Step through these actions. A single environment is reset where its episode ends."""
    for action in actions:
        ended = env.step(action)[2]
        if single and ended:
            env.reset()


def record(env: Any, steps: int, single: bool = False) -> tuple[list[Any], int]:
    """(one uniform valid action a row for each step after ``reset(seed=SEED)``, the number of decisions in them)."""
    rng, actions, decisions = np.random.default_rng(SEED), [], 0
    _, info = env.reset(seed=SEED)
    done: Any = np.zeros(1 if single else env.num_envs, np.bool_)
    for _ in range(steps):
        mask = np.atleast_2d(info["action_mask"])
        chosen = np.argmax(rng.random(mask.shape) * mask, axis=1)
        actions.append(int(chosen[0]) if single else chosen)
        decisions += int((~done).sum())  # a row that has ended spends its next step on its reset
        _, _, terminated, truncated, info = env.step(actions[-1])
        if not single:
            done = terminated | truncated
        elif terminated:
            _, info = env.reset()
    return actions, decisions


def _rate(env: Any, steps: int, repeats: int, single: bool = False) -> float:
    """Decisions a second."""
    actions, decisions = record(env, steps, single)
    best = best_s(repeats, partial(env.reset, seed=SEED), partial(play, env, actions, single))
    env.close()
    return decisions / best


def measure(sizes: Sizes | None = None) -> list[Measurement]:
    """Speed of the batches, of the single environments and of rollouts."""
    sizes = sizes or Sizes()
    compile_here()
    return [*_batches(sizes), *_singles(sizes), *_rollouts(sizes)]


def _batches(sizes: Sizes) -> Iterator[Measurement]:
    def figure(of: str, id: str, mode: str, steps: int, capacity: int, goal: float | None, what: str) -> Measurement:
        vector = gym.make_vec(id, sizes.batch, vectorization_mode=mode, capacity=capacity)
        definition = f"{what} a second of gym.make_vec(vectorization_mode='{mode}'), n = {sizes.batch}, L = {capacity}"
        definition += ", all observation fields, resets in the time"
        return Measurement(f"{of}, {id}", _rate(vector, steps, sizes.repeats), "steps/s", goal, definition)

    for id, goal in ENVIRONMENTS.items():
        native = figure("native batch", id, NATIVE, sizes.steps, sizes.capacity, goal, "decisions")
        sync = figure("SyncVectorEnv", id, "sync", sizes.sync_steps, sizes.capacity, None, "decisions")
        yield from (native, sync)
        ratio = native.value / sync.value
        yield Measurement(f"native / SyncVectorEnv, {id}", ratio, "times", 50.0, "the ratio of these two")
    of, what = f"native batch of {len(scenarios.get('topics').topics)} topics", "decisions and choices of what to send"
    yield figure(of, TOPICS, NATIVE, sizes.steps, sizes.topic_slots, 5e6, what)


def _singles(sizes: Sizes) -> Iterator[Measurement]:
    definition = f"calls of Env.step a second, without wrappers, L = {sizes.capacity}, all observation fields, "
    definition += "resets in the time"
    for id in ENVIRONMENTS:
        rate = _rate(gym.make(id, capacity=sizes.capacity).unwrapped, sizes.single_steps, sizes.repeats, single=True)
        yield Measurement(f"single environment, {id}", rate, "steps/s", 3e5, definition)


def _rollouts(sizes: Sizes) -> Iterator[Measurement]:
    scenario = scenarios.get("lte")
    episodes = [draw(scenario, seed) for seed in range(sizes.episodes)]
    arrivals = sum(len(episode.arrivals) for episode in episodes)
    senders = Senders(len(episodes), sizes.capacity, scenario.value, max_messages=scenario.max_messages)
    definition = f"arrivals a second of Senders.run, {len(episodes)} episodes of scenario lte, L = {sizes.capacity};"
    definition += " drawing, loading and scoring them not in the time"
    load = partial(senders.load_all, [(i, episode, None) for i, episode in enumerate(episodes)])
    for name in POLICIES:
        run = partial(senders.run, policies.get(name))
        load()
        run()  # compiled, or loaded from disk, before the clock starts
        rate = arrivals / best_s(sizes.repeats, load, run)
        yield Measurement(f"rollout, {name}", rate, "arrivals/s", 4e7, definition)


def report(figures: Sequence[Measurement], repeats: int) -> str:
    """Figures beside their targets, then their definitions."""
    measured = [
        [f.name, f"{_human(f.value)} {f.unit}", f"{_human(f.target)} {f.unit}" if f.target else ""] for f in figures
    ]
    lines = [Table(["", "measured", "target"], [("", measured)]).plain()]
    lines += ["", f"Best of {repeats} repeats each, one thread. Actions drawn beforehand among the valid ones."]
    if not JIT:
        lines.append("Compilation is off (NUMBA_DISABLE_JIT): these figures say nothing about bufgym's speed.")
    return "\n".join([*lines, *dict.fromkeys(f"- {f.name.split(',')[0]}: {f.definition}" for f in figures)])


def _human(number: float) -> str:
    """Three digits and a prefix: 3.14 M, 120 k, 57.3."""
    for size, prefix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if number >= size:
            return f"{number / size:.3g}{prefix}"
    return f"{number:.3g}"


def write_json(figures: Sequence[Measurement], sizes: Sizes, path: Path) -> None:
    """Write figures, sizes, and the versions and machine they were measured on."""
    document = {
        "versions": {name: version(name) for name in ("bufgym", "numpy", "numba", "gymnasium")},
        "python": platform.python_version(),
        "machine": platform.machine(),
        "processors": os.cpu_count(),
        "compiled": JIT,
        "sizes": asdict(sizes),
        "figures": [figure._asdict() for figure in figures],
    }
    with replaced(path) as temporary:
        temporary.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
