"""Fig. 9 of the AFR paper: how long one decision takes.

Each built-in policy decides for a full queue, in two ways: inside compiled code, as in rollouts and training, and
called from Python one decision at a time, as a live queue does. The paper's numbers are from its own machine and ROS
program; ORBBuf's is with ORB features recomputed from images, where ours compares recorded motion. Times are of this
machine and differ from run to run; what is to be compared is the order of magnitude.
"""

from __future__ import annotations

import functools
import time
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from bufgym import policies
from bufgym import sim as sender
from bufgym.errors import BufgymError
from bufgym.kernel import JIT, compile_for, records
from bufgym.model.buffer import ACCEPT, MESSAGE, Buffer
from bufgym.policies.registry import Policy, signatures
from bufgym.reproduce.report import COLOURS, Report
from bufgym.scenario import Interruption

PAPER = {"afr": "< 10 us", "drop-oldest": "< 10 us", "random": "< 10 us", "orbbuf": "~ 10 ms"}
"""The paper's figure; ORBBuf's with features recomputed."""
LIMIT_COMPILED_US, LIMIT_PYTHON_US = 1.0, 10.0
"""Ours for the paper's three fast policies: inside compiled code, and called from Python (median)."""
REPEATS = 5
"""Compiled loops timed; the fastest counts, as the others met something else on the machine."""


def decide_often(
    buffer: Buffer,
    arrivals: NDArray[Any],
    memory: NDArray[np.float64],
    start: NDArray[np.float64],
    on_arrival: Any,
    rounds: int,
) -> int:
    """Decide ``rounds`` times on each of ``arrivals``; the sum of the decisions, so that none can be left out."""
    total = 0
    for _ in range(rounds):
        # Each round is an interruption of its own: else r of AFR would double without end.
        for j in range(len(start)):
            memory[j] = start[j]
        for k in range(len(arrivals)):
            total += on_arrival(buffer, arrivals[k], memory)
    return total


@functools.cache
def compiled_loop() -> Any:
    """``decide_often`` compiled once for every policy, as the rollout is."""
    arrival, *_ = signatures()
    view, message, reals = arrival.args
    messages = numba.types.Array(message, 1, "C")
    int_ = numba.types.int64
    return compile_for(int_(view, messages, reals, reals, numba.types.FunctionType(arrival), int_), decide_often)


def full_queue(capacity: int, arrivals: int) -> tuple[Buffer, NDArray[Any]]:
    """A full queue in an interruption, as a policy sees it, and MESSAGE[``arrivals``], the next to come."""
    interruption = Interruption(law="fixed", t_max=capacity + arrivals)
    episode = interruption.episode(capacity + arrivals).with_uniforms(np.random.Generator(np.random.PCG64(0)))
    seen: list[Buffer] = []

    def watch(buffer: Buffer, arrival: Any, memory: NDArray[np.float64]) -> int:
        if len(buffer.slots) < capacity:
            return ACCEPT
        if not seen:
            slots = records(capacity, MESSAGE)
            slots[:] = buffer.slots  # a copy: the sender goes on
            numbers = {
                f: getattr(buffer, f).item() for f in Buffer._fields if isinstance(getattr(buffer, f), np.generic)
            }
            seen.append(buffer._replace(slots=slots, **numbers))
        return 0

    sender.run(Policy("watch", watch), [episode], capacity, interruption.value)
    return seen[0], np.ascontiguousarray(episode.arrivals[capacity + 1 : -1])


def inside_us(policy: Policy, buffer: Buffer, arrivals: NDArray[Any], decisions: int) -> float:
    """Time of one decision in a compiled loop (in a Python loop where compilation is off), us."""
    loop, on_arrival = compiled_loop(), policy.compiled[0]
    buffer = buffer._replace(parameters=policy.parameter_array)
    rounds = max(1, decisions // len(arrivals))
    start, memory = policy.new_memory(2, buffer.capacity)
    loop(buffer, arrivals, memory, start, on_arrival, 1)
    fastest = np.inf
    for _ in range(REPEATS):
        begin_ns = time.perf_counter_ns()
        loop(buffer, arrivals, memory, start, on_arrival, rounds)
        fastest = min(fastest, time.perf_counter_ns() - begin_ns)
    return float(fastest) / (rounds * len(arrivals)) / 1e3


def called_us(policy: Policy, buffer: Buffer, arrivals: NDArray[Any], calls: int) -> tuple[float, float]:
    """Median and 99th percentile of one call from Python, the clock's own time included, us."""
    on_arrival, (start, memory) = policy.compiled[0], policy.new_memory(2, buffer.capacity)
    buffer = buffer._replace(parameters=policy.parameter_array)
    one_by_one = [arrivals[k] for k in range(len(arrivals))]
    taken_ns = np.zeros(calls, np.int64)
    for i in range(calls):
        k = i % len(one_by_one)
        if k == 0:
            memory[:] = start
        begin_ns = time.perf_counter_ns()
        on_arrival(buffer, one_by_one[k], memory)
        taken_ns[i] = time.perf_counter_ns() - begin_ns
    return float(np.median(taken_ns)) / 1e3, float(np.percentile(taken_ns, 99)) / 1e3


def report(capacity: int = 8, decisions: int = 1_000_000, calls: int = 20_000) -> Report:
    """Fig. 9 with L = ``capacity``: ``decisions`` in the compiled loop and ``calls`` from Python for each policy."""
    if decisions < 1 or calls < 1:
        raise BufgymError(f"decisions = {decisions}, calls = {calls}: must be whole numbers >= 1")
    buffer, arrivals = full_queue(capacity, 400)
    # Built-in ones alone: a user's policy names no source.
    known = map(policies.get, policies.names(for_topics=False))
    measured = [p for p in known if p.compile and p.source and p.privileged is None]
    rows: list[list[Any]] = []
    for policy in measured:
        inside, (median, p99) = (
            inside_us(policy, buffer, arrivals, decisions),
            called_us(policy, buffer, arrivals, calls),
        )
        rows.append([policy.name, inside, median, p99, PAPER.get(policy.name, "-")])
    how = "compiled loop" if JIT else "Python loop (compilation is off)"
    lines = [
        f"AFR paper, Fig. 9: time of one decision on this machine, full queue, L = {capacity}, us.",
        f"Inside: {decisions:,} decisions in a {how}. Called: {calls:,} single calls from Python, median and p99.",
        "",
        f"{'policy':16} {'inside':>9} {'called':>9} {'p99':>9}  paper",
        *(f"{name:16} {inside:9.4f} {median:9.2f} {p99:9.2f}  {paper}" for name, inside, median, p99, paper in rows),
        "",
        "The paper's ORBBuf recomputes ORB features of images; ours compares recorded motion.",
    ]
    for name, inside, median, _, paper in rows:
        if paper.startswith("<"):
            lines.append(
                f"{name}: inside under {LIMIT_COMPILED_US:g} us: {_yes(inside < LIMIT_COMPILED_US)}; "
                f"called under {LIMIT_PYTHON_US:g} us: {_yes(median < LIMIT_PYTHON_US)}"
            )

    def draw(figure: Any) -> None:
        axes = figure.add_subplot()
        at = np.arange(len(rows))
        inside, median, p99 = (np.array([row[k] for row in rows]) for k in (1, 2, 3))
        axes.plot(inside, at, "o", color=COLOURS["afr"], label=f"inside a {how}")
        axes.hlines(at, median, p99, color=COLOURS["random"], linewidth=1.5)
        axes.plot(median, at, "s", color=COLOURS["random"], label="called from Python, median to p99")
        fast = [i for i, row in enumerate(rows) if row[4].startswith("<")]
        slow = [i for i, row in enumerate(rows) if row[4].startswith("~")]
        axes.plot([10.0] * len(fast), fast, "<", color=COLOURS["drop-oldest"], label="paper: under 10 us")
        axes.plot(
            [10e3] * len(slow), slow, "D", color=COLOURS["drop-oldest"], label="paper: ORBBuf, features recomputed"
        )
        axes.set(xscale="log", xlabel="time of one decision, us")
        axes.set_yticks(at, [row[0] for row in rows])
        axes.invert_yaxis()
        axes.set_title(f"One decision on a full queue, L = {capacity}, this machine", loc="left")
        axes.grid(alpha=0.25)
        figure.legend(loc="outside lower center", ncols=2, frameon=False)

    header = ["policy", "inside_us", "called_median_us", "called_p99_us", "paper"]
    return Report("\n".join(lines), header, rows, draw, (7.0, 0.34 * len(rows) + 2.2))


def _yes(holds: bool) -> str:
    return "yes" if holds else "NO"
