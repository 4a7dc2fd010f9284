"""Where the time of a step goes: the parts of a native batch's step, and of a single environment's, timed apart.

What a kernel writes is timed alone, again and again over the batch as it stands after a while; the transition is what
is left of the whole.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from bufgym.benchmark.perf import ENVIRONMENTS, SEED, TOPICS, Sizes, best_s, record
from bufgym.envs.step import StepOutput, step_rows, write_mask, write_observation
from bufgym.kernel import compile_here, kernel
from bufgym.sim import NOTHING_WAITS, Batch

_TIMES = 20
"""Passes over the batch in one timing of what a kernel writes."""


@dataclass(frozen=True)
class Part:
    """One part of a step."""

    of: str
    """The environment and its kind."""
    name: str
    """What is done."""
    ns: float
    """A decision, ns."""
    share: float
    """Of the whole step."""


@kernel
def _observe_all(batch: Batch, output: StepOutput) -> None:
    """Every row's observation and mask."""
    for i in range(len(batch.senders)):
        write_observation(batch, i, False, output)


@kernel
def _mask_all(batch: Batch, output: StepOutput) -> None:
    """Every row's mask."""
    for i in range(len(batch.senders)):
        if batch.senders[i].waiting != NOTHING_WAITS:
            write_mask(batch, i, output.action_mask)


class _Clock:
    """The time spent inside of functions, s."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def timed(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """``function``, whose time counts from now on."""

        def call(*arguments: Any) -> Any:
            begin = time.perf_counter()
            try:
                return function(*arguments)
            finally:
                self.seconds += time.perf_counter() - begin

        return call


def profile(sizes: Sizes | None = None) -> list[Part]:
    """The parts of a step of the native batches, then of the single environment, those of each adding up to it."""
    sizes = sizes or Sizes()
    compile_here()
    parts = [part for id in ENVIRONMENTS for part in _batch(id, sizes.capacity, sizes)]
    return [*parts, *_batch(TOPICS, sizes.topic_slots, sizes), *_single(ENVIRONMENTS[0], sizes)]


def _batch(id: str, capacity: int, sizes: Sizes) -> Iterable[Part]:
    vector: Any = gym.make_vec(id, sizes.batch, vectorization_mode="vector_entry_point", capacity=capacity)
    actions, decisions = record(vector, sizes.steps)
    rows, stepping, beginning = vector.unwrapped.rows, _Clock(), _Clock()
    rows.step, rows.reset = stepping.timed(rows.step), beginning.timed(rows.reset)

    def begin() -> None:
        vector.reset(seed=SEED)
        stepping.seconds = beginning.seconds = 0.0

    def play() -> None:
        for row in actions:
            vector.step(row)

    best = (np.inf, 0.0, 0.0)
    for _ in range(sizes.repeats):
        whole = best_s(1, begin, play)
        best = min(best, (whole, stepping.seconds, beginning.seconds))
    whole, in_kernel, in_reset = (seconds / decisions * 1e9 for seconds in best)
    batch, output = rows.senders.batch, rows.output
    asks = max(1, int((batch.senders["waiting"] != NOTHING_WAITS).sum()))

    def written(kernel: Callable[..., None]) -> float:
        """ns a decision."""

        def work() -> None:
            for _ in range(_TIMES):
                kernel(batch, output)

        work()
        return best_s(sizes.repeats * _TIMES, lambda: None, work) / _TIMES / asks * 1e9

    masks = written(_mask_all)
    fields = written(_observe_all) - masks
    numbers = output.flat.shape[1]
    vector.close()
    yield from _shared(
        f"native batch of {sizes.batch}, {id}, L = {capacity}",
        whole,
        {
            f"observation ({numbers} numbers)": fields,
            "action mask": masks,
            "decision, transition, rewards": in_kernel - fields - masks,
            "episodes drawn and begun": in_reset,
            "Python around the kernel": whole - in_kernel - in_reset,
        },
    )


def _single(id: str, sizes: Sizes) -> Iterable[Part]:
    env: Any = gym.make(id, capacity=sizes.capacity).unwrapped
    reject, rows = sizes.capacity, env.rows
    calls = {name: _Clock() for name in ("step", "observation", "info", "reset")}
    for name, clock in calls.items():
        setattr(rows, name, clock.timed(getattr(rows, name)))

    def begin() -> None:
        env.reset(seed=SEED)
        for clock in calls.values():
            clock.seconds = 0.0

    def play() -> None:
        for _ in range(sizes.single_steps):
            if env.step(reject)[2]:
                env.reset()

    best: tuple[float, ...] = (np.inf,)
    for _ in range(sizes.repeats):
        whole = best_s(1, begin, play)
        best = min(best, (whole, *(clock.seconds for clock in calls.values())))
    whole, stepping, observing, informing, beginning = (seconds / sizes.single_steps * 1e9 for seconds in best)
    # A row whose episode has ended is not stepped: what its call takes, any call of the kernel takes.
    env.reset(seed=SEED)
    rows.senders.batch.senders["waiting"] = NOTHING_WAITS
    action, row = np.array([reject]), np.zeros(1, np.int64)

    def call() -> None:
        for _ in range(1000):
            step_rows(rows.senders.batch, row, action, rows.rewarded, rows.output)

    calling = min(best_s(sizes.repeats, lambda: None, call) / 1000 * 1e9, stepping)
    yield from _shared(
        f"single environment, {id}, L = {sizes.capacity}",
        whole,
        {
            "handing a kernel its arrays": calling,
            "the kernel itself": stepping - calling,
            "the observation's dict of views": observing,
            "info": informing,
            "episodes drawn and begun": beginning,
            "the rest of Env.step, in Python": whole - stepping - observing - informing - beginning,
        },
    )


def _shared(of: str, whole: float, parts: dict[str, float]) -> Iterable[Part]:
    for name, ns in parts.items():
        yield Part(of, name, ns, ns / whole)


def report(parts: list[Part]) -> str:
    """The parts of each environment's step, as a table."""
    lines: list[str] = []
    for part in parts:
        if part.of not in lines:
            lines += ["", part.of]
        lines.append(f"  {part.name:<34} {part.ns:8.0f} ns {part.share:6.0%}")
    return "\n".join(lines[1:])
