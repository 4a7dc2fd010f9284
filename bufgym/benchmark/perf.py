"""bufgym's own speed: each figure with its definition and its target, all from one run.

Every figure is the best of several repeats: other work on the machine can only slow a repeat down. Everything runs in
one thread. Actions are drawn beforehand, uniform among the valid ones, by playing the same seeded episodes once; so the
timed loop holds nothing but the environment's own work, its resets included.
"""

from __future__ import annotations

import functools
import json
import os
import platform
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bufgym import policies
from bufgym import scenario as scenarios
from bufgym.benchmark.run import draw
from bufgym.files import replaced
from bufgym.kernel import JIT, compile_here
from bufgym.sim import Senders

ENVIRONMENTS = ("bufgym/Uplink-v0", "bufgym/Interruption-v0")
TOPICS = "bufgym/Topics-v0"
_BATCH_GOALS = {"bufgym/Uplink-v0": 10e6, "bufgym/Interruption-v0": 8e6, TOPICS: 5e6}
POLICIES = ("afr", "drop-oldest", "random", "min-gap")
SEED = 1


@dataclass(frozen=True)
class Figure:
    """One measured figure."""

    name: str
    """What was measured."""
    value: float
    """Its result, in ``unit``."""
    unit: str
    """Of ``value`` and ``target``."""
    target: float | None
    """What bufgym aims at; None where there is no target."""
    definition: str
    """How it was measured, in a sentence."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured. The defaults take about half a minute."""

    capacity: int = 16
    """L, messages."""
    batch: int = 1024
    """Environments in a batch."""
    steps: int = 1000
    """Steps of the native batch."""
    sync_steps: int = 30
    """Steps of Gymnasium's SyncVectorEnv."""
    single_steps: int = 20_000
    """Steps of the single environment."""
    episodes: int = 1000
    """Episodes of a fixed-policy rollout."""
    repeats: int = 3
    """Repeats of each figure, of which the best counts."""
    topic_slots: int = 32
    """L of the batch with several topics."""


def measure(sizes: Sizes | None = None) -> list[Figure]:
    """Measure everything."""
    sizes = sizes or Sizes()
    compile_here()
    return [*_batches(sizes), *_singles(sizes), *_rollouts(sizes)]


def best_s(repeats: int, prepare: Callable[[], Any], work: Callable[[], Any]) -> float:
    """Shortest time of ``work``, s, over so many repeats; ``prepare`` runs before each, untimed."""
    times = []
    for _ in range(repeats):
        prepare()
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return min(times)


def random_actions(mask: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.int64]:
    """int64[n]: one valid action a row, uniform; ``mask`` is bool[n, L + 2]."""
    return np.asarray(np.argmax(rng.random(mask.shape) * mask, axis=1), np.int64)


def record(vector: Any, steps: int) -> tuple[NDArray[np.int64], int]:
    """(actions int64[steps, n] for ``reset(seed=SEED)``, how many of them are decisions and not resets)."""
    rng = np.random.default_rng(SEED)
    _, info = vector.reset(seed=SEED)
    actions = np.zeros((steps, vector.num_envs), np.int64)
    done = np.zeros(vector.num_envs, np.bool_)
    decisions = 0
    for k in range(steps):
        actions[k] = random_actions(info["action_mask"], rng)
        decisions += int((~done).sum())  # a row that has ended spends its next step on its reset
        _, _, terminated, truncated, info = vector.step(actions[k])
        done = terminated | truncated
    return actions, decisions


def _batch_rate(id: str, mode: str, steps: int, sizes: Sizes, capacity: int) -> float:
    """Decisions a second of one kind of vector environment."""
    vector: Any = gym.make_vec(id, sizes.batch, vectorization_mode=mode, capacity=capacity)

    def play() -> None:
        for row in actions:
            vector.step(row)

    try:
        actions, decisions = record(vector, steps)
        return decisions / best_s(sizes.repeats, lambda: vector.reset(seed=SEED), play)
    finally:
        vector.close()


def _batches(sizes: Sizes) -> Iterable[Figure]:
    call, rest = "gym.make_vec(vectorization_mode=", "all observation fields, resets in the time"
    batch = f"n = {sizes.batch}, L = {sizes.capacity}, {rest}"
    for id in ENVIRONMENTS:
        native = _batch_rate(id, "vector_entry_point", sizes.steps, sizes, sizes.capacity)
        sync = _batch_rate(id, "sync", sizes.sync_steps, sizes, sizes.capacity)
        definition = f"decisions a second of {call}'vector_entry_point'), {batch}"
        yield Figure(f"native batch, {id}", native, "steps/s", _BATCH_GOALS[id], definition)
        yield Figure(f"SyncVectorEnv, {id}", sync, "steps/s", None, f"decisions a second of {call}'sync'), {batch}")
        yield Figure(f"native / SyncVectorEnv, {id}", native / sync, "times", 50.0, "the ratio of these two")
    topics = len(scenarios.get("topics").topics)
    yield Figure(
        f"native batch of {topics} topics, {TOPICS}",
        _batch_rate(TOPICS, "vector_entry_point", sizes.steps, sizes, sizes.topic_slots),
        "steps/s",
        _BATCH_GOALS[TOPICS],
        f"decisions and choices of what to send a second of {call}'vector_entry_point'), "
        f"n = {sizes.batch}, L = {sizes.topic_slots}, {rest}",
    )


def _single_rate(id: str, sizes: Sizes) -> float:
    """Calls of Env.step a second."""
    env: Any = gym.make(id, capacity=sizes.capacity).unwrapped
    rng = np.random.default_rng(SEED)
    actions = []
    _, info = env.reset(seed=SEED)
    for _ in range(sizes.single_steps):
        actions.append(int(random_actions(info["action_mask"][None], rng)[0]))
        _, _, ended, _, info = env.step(actions[-1])
        if ended:
            _, info = env.reset()

    def play() -> None:
        for action in actions:
            if env.step(action)[2]:
                env.reset()

    return len(actions) / best_s(sizes.repeats, lambda: env.reset(seed=SEED), play)


def _singles(sizes: Sizes) -> Iterable[Figure]:
    definition = (
        f"calls of Env.step a second, without wrappers, L = {sizes.capacity}, all observation fields, "
        "resets in the time"
    )
    for id in ENVIRONMENTS:
        yield Figure(f"single environment, {id}", _single_rate(id, sizes), "steps/s", 3e5, definition)


def _rollouts(sizes: Sizes) -> Iterable[Figure]:
    scenario = scenarios.get("lte")
    episodes = [draw(scenario, seed) for seed in range(sizes.episodes)]
    arrivals = sum(len(episode.arrivals) for episode in episodes)
    senders = Senders(len(episodes), sizes.capacity, scenario.value, max_messages=scenario.max_messages)
    definition = (
        f"arrivals a second of Senders.run, {len(episodes)} episodes of scenario lte, L = {sizes.capacity};"
        " drawing, loading and scoring them not in the time"
    )

    def load() -> None:
        senders.load_all([(i, episode, None) for i, episode in enumerate(episodes)])

    for name in POLICIES:
        run = functools.partial(senders.run, policies.get(name))
        load()
        run()  # compiled, or loaded from disk, before the clock starts
        rate = arrivals / best_s(sizes.repeats, load, run)
        yield Figure(f"rollout, {name}", rate, "arrivals/s", 4e7, definition)


def human(number: float) -> str:
    """Three digits and a prefix: 3.14 M, 120 k, 57.3."""
    for size, prefix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if number >= size:
            return f"{number / size:.3g}{prefix}"
    return f"{number:.3g}"


def report(figures: list[Figure], repeats: int) -> str:
    """Figures beside their targets, then what each is."""
    names, values = [figure.name for figure in figures], [f"{human(figure.value)} {figure.unit}" for figure in figures]
    targets = ["" if f.target is None else f"(target {human(f.target)} {f.unit})" for f in figures]
    widths = max(map(len, names)), max(map(len, values))
    lines = [
        f"{name:<{widths[0]}}  {value:>{widths[1]}}  {target}".rstrip()
        for name, value, target in zip(names, values, targets, strict=True)
    ]
    lines += ["", f"Best of {repeats} repeats each, one thread. Actions drawn beforehand among the valid ones."]
    if not JIT:
        lines.append("Compilation is off (NUMBA_DISABLE_JIT): these figures say nothing about bufgym's speed.")
    lines += dict.fromkeys(f"- {figure.name.split(',')[0]}: {figure.definition}" for figure in figures)
    return "\n".join(lines)


def write_json(figures: list[Figure], sizes: Sizes, path: Path) -> None:
    """Figures, sizes and what they were measured on."""
    document = {
        "versions": {name: version(name) for name in ("bufgym", "numpy", "numba", "gymnasium")},
        "python": platform.python_version(),
        "machine": platform.machine(),
        "processors": os.cpu_count(),
        "compiled": JIT,
        "sizes": asdict(sizes),
        "figures": [asdict(figure) for figure in figures],
    }
    with replaced(path) as temporary:
        temporary.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
