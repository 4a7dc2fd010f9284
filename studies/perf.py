"""bufgym's own speed: its environments and its rollouts, beside a bare kernel that does the job of one step.

``python -m studies.perf [--json FILE] [--history FILE] [--repeats N] [--quick]``

Every figure is the best of several repeats in time of the processor, because other work on the machine can only slow a
repeat down. Each repeat times the ``microbenchmark`` too: their ratio says more than either. Actions are drawn before,
uniform among the valid ones, by playing the same seeded episodes once. So the timed loop holds only the environment's
own work and its resets.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from functools import partial
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from bufgym import policies
from bufgym import scenario as scenarios
from bufgym.cli.options import Count
from bufgym.envs import SenderVectorEnv, expert
from bufgym.jit import JIT
from bufgym.model.topics import Topic
from bufgym.scenario.client import Client, Stream
from bufgym.scenario.draws import shipped
from bufgym.scenario.numbered import draw
from bufgym.sim import Senders
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import write_text
from bufgym.utils.tables import Table
from studies import microbenchmark
from studies.page import command

ENVIRONMENTS = ("bufgym/Uplink-v1", "bufgym/Interruption-v1")
TOPICS = "bufgym/Topics-v0"
SCHEDULER = "gap-priority"
POLICIES = ("afr", "drop-oldest", "min-gap", "target-gap", "learned")
NATIVE = "vector_entry_point"
SEED = 1
NAMED = ["rank", "loss", "occupancy", "rate_long"]
"""Fields that a batch names: two for each slot, one of the context's and one outside the tables."""
BUSY, CROWDS = 8, (8, 256)
"""Topics that publish 8 messages a second each, and topics in all: the others publish once an episode."""
LABELLED = 64
"""Environments side by side whose decisions the clairvoyant labels."""
FELL, BEFORE = 0.15, 5  # A ratio fell if it is lower by more than this share than the median of so many runs before


class Measurement(NamedTuple):
    """One measured figure in ``unit``. ``definition`` says how it was measured.

    ``ratio`` is to the microbenchmark's steps a second, in the same repeats.
    """

    name: str
    value: float
    unit: str
    ratio: float | None
    definition: str


@dataclass(frozen=True)
class Sizes:
    """How much is measured. The defaults take about a minute."""

    capacity: int = 16  # L, messages
    batches: tuple[int, ...] = (1024, 64, 16)  # environments in a batch
    decisions: int = 1_000_000  # of each batch: episodes end and begin
    single_steps: int = 20_000  # of the single environment
    episodes: int = 1000  # of a fixed-policy rollout
    repeats: int = 3  # of each figure; the best one counts
    topic_slots: int = 32  # L of the batches with several topics

    def steps(self, n: int) -> int:
        """Steps of a batch of ``n``."""
        return max(1, self.decisions // n)


Clock = Callable[[], float]
Work = Callable[[], Any]


def best_s(repeats: int, prepare: Work, work: Work, clock: Clock = time.process_time) -> float:
    """Shortest time of ``work`` over the repeats, s. ``prepare`` runs before each, untimed."""
    times = []
    for _ in range(repeats):
        prepare()
        begin = clock()
        work()
        times.append(clock() - begin)
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


class _Meter:
    """Makes figures, each beside the microbenchmark, which runs between their repeats."""

    def __init__(self, sizes: Sizes) -> None:
        self.sizes, (self._work, self._steps) = sizes, microbenchmark.passes(max(sizes.batches), sizes.capacity)
        about = f"steps a second of studies.microbenchmark, n = {max(sizes.batches)}, L = {sizes.capacity}"
        self._work()  # compiled, or loaded from disk, before the clock starts
        self.microbenchmark = self.figure("microbenchmark", about, self._steps, "steps", lambda: None, self._work)

    def figure(
        self, name: str, about: str, count: int, unit: str, prepare: Work, work: Work, clock: Clock = time.process_time
    ) -> Measurement:
        """``count`` of ``unit`` in the time of ``work``."""
        bare_s = work_s = float("inf")
        for _ in range(self.sizes.repeats):
            bare_s = min(bare_s, best_s(5, lambda: None, self._work, clock))
            work_s = min(work_s, best_s(1, prepare, work, clock))
        return Measurement(name, count / work_s, f"{unit}/s", count / work_s * bare_s / self._steps, about)

    def of_env(self, name: str, about: str, env: Any, steps: int, single: bool = False, **options: Any) -> Measurement:
        """Decisions a second."""
        actions, decisions = record(env, steps, single)
        reset, work = partial(env.reset, seed=SEED), partial(play, env, actions, single)
        found = self.figure(name, f"{about}, resets in the time", decisions, "steps", reset, work, **options)
        env.close()
        return found


def measure(sizes: Sizes | None = None) -> list[Measurement]:
    """Speed of the microbenchmark, the batches, the single environments and of rollouts."""
    meter = _Meter(sizes or Sizes())
    return [meter.microbenchmark, *_batches(meter), *_singles(meter), *_rollouts(meter), _labels(meter)]


def _batches(meter: _Meter) -> Iterator[Measurement]:
    sizes = meter.sizes
    about = f"decisions a second of gym.make_vec(vectorization_mode='{NATIVE}'), L = {sizes.capacity}"
    about += f" ({sizes.topic_slots} for topics, where choices of what to send count too)"

    def figure(id: str, n: int, what: str = "", clock: Clock = time.process_time, **options: Any) -> Measurement:
        capacity = sizes.topic_slots if id == TOPICS else sizes.capacity
        vector = gym.make_vec(id, n, vectorization_mode=NATIVE, capacity=capacity, **options)
        return meter.of_env(f"native batch{what}, {id}, n = {n}", about, vector, sizes.steps(n), clock=clock)

    yield from (figure(id, n) for id in (*ENVIRONMENTS, TOPICS) for n in sizes.batches)
    largest = max(sizes.batches)
    yield figure(ENVIRONMENTS[0], largest, " of slots with four named fields", fields=NAMED, actions="slots")
    yield figure(ENVIRONMENTS[0], largest, " with four named fields", fields=NAMED)
    yield figure(ENVIRONMENTS[0], max(sizes.batches), " on 2 threads", time.perf_counter, num_threads=2)
    yield from (figure(TOPICS, min(sizes.batches), f" of {k} topics", scenario=crowd(k)) for k in CROWDS)


def crowd(topics: int) -> Client:
    """A client of so many topics, of which ``BUSY`` publish nearly everything: the same messages wait in all."""
    streams = [Stream(Topic(f"{k}", 1.0 + k % 3), 8.0 if k < BUSY else 1e-3, 60_000) for k in range(topics)]
    return Client(tuple(streams), shipped()["traces"], scale=0.5)


def _singles(meter: _Meter) -> Iterator[Measurement]:
    steps, capacity = meter.sizes.single_steps, meter.sizes.capacity
    about = f"calls of Env.step a second, without wrappers, L = {capacity}"
    for id in ENVIRONMENTS:
        for form in ("flat", "dict"):
            env = gym.make(id, capacity=capacity, observation=form).unwrapped
            yield meter.of_env(f"single environment, {form}, {id}", about, env, steps, single=True)
    cart, pushes = gym.make("CartPole-v1").unwrapped, np.random.default_rng(SEED).integers(2, size=steps)
    reset, work = partial(cart.reset, seed=SEED), partial(play, cart, pushes, True)
    yield meter.figure("single CartPole-v1", "the same of Gymnasium's", steps, "steps", reset, work)


def _rollouts(meter: _Meter) -> Iterator[Measurement]:
    sizes = meter.sizes
    yield from _rolled(meter, "scenario lte", scenarios.get("lte"), sizes.episodes, sizes.capacity, POLICIES)
    for topics in CROWDS:
        what = f"{topics} topics"
        yield from _rolled(meter, what, crowd(topics), -(-sizes.episodes // 50), sizes.topic_slots, [SCHEDULER])


def _rolled(
    meter: _Meter, what: str, scenario: Any, count: int, capacity: int, names: Sequence[str]
) -> Iterator[Measurement]:
    episodes = [draw(scenario, seed) for seed in range(count)]
    arrivals = sum(len(episode.arrivals) for episode in episodes)
    senders = Senders(count, capacity, scenario.value, max_messages=scenario.max_messages, topics=scenario.topics)
    about = f"arrivals a second of Senders.run, {count} episodes of {what}, L = {capacity};"
    about += " drawing, loading and scoring them not in the time"
    load = partial(senders.load_all, [(i, episode, None) for i, episode in enumerate(episodes)])
    for name in names:
        run = partial(senders.run, policies.get(name))
        load()
        run()  # compiled, or loaded from disk, before the clock starts
        title = f"rollout, {name}" if names is POLICIES else f"rollout, {name}, {what}"
        yield meter.figure(title, about, arrivals, "arrivals", load, run)


def _labels(meter: _Meter) -> Measurement:
    """Decisions of the rule gap-price, each with the regrets of all actions, as imitation needs them."""
    n, steps = LABELLED, meter.sizes.single_steps // 20
    envs = SenderVectorEnv(n, capacity=8, autoreset_mode="SameStep", info="mask", actions="slots")
    rule, clairvoyant = expert.policy(envs, "gap-price"), expert.clairvoyant(envs)

    def label() -> None:
        for _ in range(steps):
            clairvoyant.regrets()
            envs.step(rule.actions())

    reset = partial(envs.reset, seed=SEED)
    reset()
    label()  # compiled, or loaded from disk, before the clock starts
    about = f"decisions a second of gap-price with clairvoyant.regrets(), n = {n}, L = 8, loading episodes in the time"
    return meter.figure("labels of the clairvoyant", about, n * steps, "labels", reset, label)


def report(figures: Sequence[Measurement], repeats: int) -> str:
    """Figures beside their ratios to the microbenchmark, then their definitions."""
    rows = [[f.name, f"{_human(f.value)} {f.unit}", f"{f.ratio:.3g}" if f.ratio else ""] for f in figures]
    lines = [Table(["", "measured", "microbenchmarks"], [("", rows)]).plain()]
    lines += ["", f"Best of {repeats} repeats each, in time of the processor (2 threads: in time that passed)."]
    lines.append("Actions drawn beforehand among the valid ones.")
    if not JIT:
        lines.append("Compilation is off (BUFGYM_KERNELS): these figures say nothing about bufgym's speed.")
    definitions = {f.definition: f"- {f.name.split(',')[0]}: {f.definition}" for f in reversed(figures)}
    return "\n".join([*lines, *reversed(definitions.values())])


def _human(number: float) -> str:
    """Three digits and a prefix: 3.14 M, 120 k, 57.3."""
    for size, prefix in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if number >= size:
            return f"{number / size:.3g}{prefix}"
    return f"{number:.3g}"


def write_json(figures: Sequence[Measurement], sizes: Sizes, path: Path) -> None:
    """Write figures, sizes, and the versions and machine they were measured on."""
    document = {
        "versions": {name: version(name) for name in ("bufgym", "numpy", "gymnasium")},
        "python": platform.python_version(),
        "machine": platform.machine(),
        "processors": os.cpu_count(),
        "compiled": JIT,
        "sizes": asdict(sizes),
        "figures": [figure._asdict() for figure in figures],
    }
    write_text(path, json.dumps(document, indent=2) + "\n")


def remember(figures: Sequence[Measurement], sizes: Sizes, path: Path) -> str:
    """Add a line of JSON to the file ``path``: date, version, sizes, ratios. Return what fell, in a line.

    Ratios are compared with the last runs of the same sizes.
    """
    as_in_file = json.loads(json.dumps(asdict(sizes)))  # as the file has it
    try:
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []
        before = [line["ratios"] for line in lines if line["sizes"] == as_in_file][-BEFORE:]
    except (ValueError, KeyError, TypeError) as error:
        raise BufgymError(f"{path}: not a history that studies.perf wrote ({type(error).__name__}: {error})") from None
    ratios = {figure.name: figure.ratio for figure in figures if figure.ratio}
    line = {"date": date.today().isoformat(), "version": version("bufgym"), "sizes": as_in_file, "ratios": ratios}
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")
    fallen = []
    for name, ratio in ratios.items():
        known = median([ratios[name] for ratios in before if name in ratios] or [0.0])
        if ratio < (1 - FELL) * known:
            fallen.append(f"{name}: {ratio:.3g} after {known:.3g}")
    what = f"fell by more than {FELL:.0%} below the median of the last {len(before)} runs"
    return f"{what}: {'; '.join(fallen)}" if fallen else f"no ratio {what}"


def main(*, json: Path | None = None, history: Path | None = None, repeats: Count = 3, quick: bool = False) -> None:
    """Measure bufgym's own speed on this machine, beside a bare kernel that does the job of one step.

    Args:
        json: Also write the figures to this file.
        history: Add a line to this file, and say which ratios fell below the runs before.
        repeats: Best of so many.
        quick: Tiny sizes: does it run at all?
    """
    sizes = Sizes(4, (4, 2), 80, 20, 1, repeats) if quick else Sizes(repeats=repeats)
    if not quick and sys.stderr.isatty():
        print("measuring; this takes about a minute ...", file=sys.stderr)
    figures = measure(sizes)
    print(report(figures, sizes.repeats))
    if json is not None:
        write_json(figures, sizes, json)
    if history is not None:
        print(remember(figures, sizes, history))


if __name__ == "__main__":
    command(main)
