"""How much is left for an agent that does not know the future? A slow planner that knows the laws tells.

    python -m studies.causal_planner --task uplink
    python -m studies.causal_planner --task lte-v2 --capacities 5,15

At every arrival the planner takes the action that is best on average over futures of link and motion, drawn from their
laws given what the robot has seen (``studies.futures``). The value of an action in one future is the clairvoyant's: the
best H attainable from the present queue with that future known. This is hindsight planning (Chong, Givan and Chang
2000), also called QMDP. It is a policy, so its score can be reached, and a better policy may exist: it decides as if
the future were told right after the decision.

With room in the queue accepting costs the clairvoyant nothing, so values are often equal. Of equal actions it takes the
one of ``target-gap``, else it accepts.

Each episode's rows are kept in a file, so a run that was stopped goes on.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.held_out import FIRST_SEED, HELD_OUT_TRACES, split_scenario
from agents.tasks import Environment
from bufgym import policies
from bufgym.benchmark.rows import RUNS, Row, read_rows, write_rows
from bufgym.benchmark.score import scores
from bufgym.benchmark.tasks.queue import QueueTask, columns
from bufgym.cli.options import Capacities, Count, Natural, Positive
from bufgym.model.buffer import ACCEPT, REJECT, Buffer
from bufgym.model.link import FOREVER
from bufgym.oracle.ahead import NO_ROOM, Ahead, find_steps, new_rivals
from bufgym.oracle.from_queue import find_values, new_work
from bufgym.oracle.programme import find_idle
from bufgym.policies import Policy
from bufgym.scenario import Uplink, suites
from bufgym.scenario.numbered import SEEDS_PER_TRACE, by_trace, draw
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.sim.state import ARRIVAL_WAITS, new_batch
from bufgym.traces.generate.lte import LTE_MODES
from bufgym.traces.shipped import SHIPPED_LTE
from studies.futures import DriveSeen, Hidden, Links, LinkSeen, prior, rates
from studies.page import command, publish, table, written

NAME = "causal-planner"
RIVALS = ("afr", "drop-oldest", "target-gap", "learned")
KEPT = 15
"""Most arrivals for which sampled futures serve; they are drawn anew as soon as something new is seen."""
TIE = 1e-9
"""Values closer than this are equal: they sum the same gaps in another order."""
AFTER_ONE = 4
"""Arrivals of a future for each message that a mean link sends, at least. Where there are more, some are left out."""
ROOM, STEPS = 1 << 16, 64  # Initial room for the staircases of all futures, and of one message


@dataclass(frozen=True)
class Planning:
    """How to plan."""

    futures: int
    """Number of futures."""
    horizon_s: float
    """How far they reach, s: the planner supposes that the stream ends there."""
    knows_end: bool
    """Whether the planner knows when the stream ends, as whoever counts arrivals of this scenario does."""


class CausalPlanner:
    """The planner in one episode. It sees what a policy sees, and knows the laws of the ``scenario``'s link and motion.

    ``links`` are hidden states of the link at the beginning (``futures.prior``). Messages must have equal sizes.
    """

    def __init__(self, planning: Planning, links: Hidden, scenario: Uplink, capacity: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._planning, self._scenario, self._capacity = planning, scenario, capacity
        self._link, self._drive = LinkSeen(links, rng), DriveSeen(rng) if scenario.motion else None
        messages_per_s = rates(links).mean() / scenario.size_bytes
        self._stride = max(1, int(scenario.rate_hz / messages_per_s / AFTER_ONE))
        n, messages = planning.futures, 2 + round(planning.horizon_s * scenario.rate_hz)
        self._batch = new_batch(n, capacity, messages, 1, scenario.value.array)
        c, between, idle, begin, stop = np.zeros((5, n, messages), np.int64)
        lead, pool = np.zeros((n, messages)), (np.zeros(ROOM, np.int64), np.zeros(ROOM), np.zeros(ROOM, np.int32))
        self._ahead = Ahead(c, between, idle, np.zeros((n, 3), np.int64), begin, stop, lead, *pool)
        self._rivals = new_rivals(STEPS)
        self._work, self._values = new_work(capacity, messages), np.zeros((n, capacity + 2))
        self._decisions = np.tile(np.arange(capacity + 2), (n, 1))
        self._mask = np.zeros((n, capacity + 2), np.int8)
        self._first = -1  # sequence number of the arrival at which the futures begin
        self._rule = policies.get("target-gap")
        self._memory = self._rule.new_memory(1, capacity)[0]

    def on_arrival(self, buffer: Buffer, arrival: Any, memory: Any) -> int:
        """Take the action with the best mean value."""
        seq, from_us, now_us = int(arrival.seq), int(buffer.previous_us), int(arrival.arrival_us)
        news = self._link.arrival(from_us, now_us, int(buffer.drained_bytes), int(buffer.drained_us))
        if self._drive is not None:
            news |= self._drive.arrival(from_us, now_us, float(arrival.x - buffer.previous_x))
        if news or self._first < 0 or seq >= self._first + KEPT:
            self._look_ahead(arrival)
        ruled, values = self._ruled(buffer, arrival), self.values(buffer, arrival)
        L = self._capacity
        order = np.array([ruled if ruled >= 0 else L + 1 if ruled == ACCEPT else L, L + 1, L, *range(L)])
        known = np.where(np.isnan(values), -np.inf, values)[order]
        action = int(order[np.argmax(known >= known.max() - TIE)])
        return action if action < L else REJECT if action == L else ACCEPT

    def _ruled(self, buffer: Buffer, arrival: Any) -> int:
        """The decision of the rule that breaks ties."""
        slots, topics = buffer.slots.copy(), buffer.topics.copy()  # compiled functions take no read-only records
        seen = buffer._replace(slots=slots, topics=topics, parameters=self._rule.parameter_array)
        return int(self._rule.compiled[0](seen, arrival, self._memory))

    def _look_ahead(self, arrival: Any) -> None:
        """Draw futures, and find the clairvoyant's gains in each."""
        n, size, now_us = self._planning.futures, int(arrival.size_bytes), int(arrival.arrival_us)
        left = round(self._planning.horizon_s * self._scenario.rate_hz)
        if self._planning.knows_end:
            left = min(left, self._scenario.max_messages - 1 - int(arrival.seq))
        near = min(KEPT, left)
        steps = np.concatenate([np.arange(near + 1), np.arange(near + self._stride, left + 1, self._stride)])
        count, times_us = len(steps), now_us + 1e6 / self._scenario.rate_hz * steps
        batch, sizes, limit = self._batch, np.full(len(steps), size), np.full(len(steps), self._capacity * size)
        batch.senders["arrivals"] = count
        batch.arrivals["x"][:, :count] = steps if self._drive is None else self._drive.moved(now_us, times_us, n)
        self._ahead.c[:, :count] = self._link.carried(now_us, times_us, n)
        self._ahead.link[:] = size, self._capacity, FOREVER
        place = 0
        for i in range(n):
            c, between, idle = (numbers[i, :count] for numbers in self._ahead[:3])
            find_idle(c, sizes, limit, limit, between, idle)
            while (end := find_steps(batch, self._ahead, i, place, self._rivals)) < 0:
                if end == NO_ROOM:
                    pool: list[NDArray[Any]] = [np.resize(array, 2 * len(array)) for array in self._ahead[7:]]
                    self._ahead = Ahead(*self._ahead[:7], *pool)
                else:
                    self._rivals = new_rivals(2 * len(self._rivals.message))
            place = end
        self._first = int(arrival.seq)

    def values(self, buffer: Buffer, arrival: Any) -> NDArray[np.float64]:
        """float64[L + 2]: the mean gain still attainable after each action, over the futures; NaN if invalid."""
        batch, senders, L, s = self._batch, self._batch.senders, self._capacity, len(buffer.slots)
        k = int(arrival.seq) - self._first
        senders["capacity"], senders["waiting"], senders["next"] = L, ARRIVAL_WAITS, k
        senders["first"], senders["occupancy"], senders["busy"] = 1, s, buffer.busy
        senders["dequeued"] = senders["credited"] = buffer.dequeued > 0
        senders["position"] = buffer.busy * (self._ahead.c[:, k] + buffer.left_bytes)
        # Each future has bytes and x of its own for the present.
        shift = batch.arrivals["x"][:, k] - arrival.x
        batch.slots["x"][:, 0] = buffer.dequeued_x + shift
        batch.slots["x"][:, 1 : 1 + s] = buffer.slots["x"] + shift[:, None]
        find_values(batch, self._ahead, self._work, self._decisions, self._values)
        return np.asarray(self._values.mean(axis=0))


class Case(NamedTuple):
    """One episode of a task, with L = ``capacity``."""

    label: str
    trace: str
    seed: int
    scenario: Uplink
    capacity: int


def uplink_cases(capacities: Sequence[int], episodes: int) -> Iterator[Case]:
    """Episodes of ``bufgym/Uplink-v0`` on the two shipped links that ``train.py`` holds out."""
    for L in capacities or (8,):
        on = Environment(capacity=L)
        scenario = split_scenario(on)[True]
        assert isinstance(scenario, Uplink)
        scenario = replace(scenario, traces=scenario.traces[:HELD_OUT_TRACES])
        for k in range(episodes or on.episodes):
            yield Case("", "", FIRST_SEED["test"] + k, scenario, L)


def lte_cases(capacities: Sequence[int], episodes: int) -> Iterator[Case]:
    """The first of the test episodes of ``lte-v2`` on each link, or on the first ``episodes`` links."""
    suite = suites.get("lte-v2")
    for k in range(episodes or len(next(iter(suite.settings("test").values())).scenario.traces)):
        for label, setting in suite.settings("test").items():
            trace, scenario = by_trace(setting.scenario)[k]
            for L in capacities or suite.capacities:
                yield Case(label, trace, SEEDS_PER_TRACE * k, scenario, L)


LTE_V2: Links = [(mode, mean) for mode in LTE_MODES for mean in (3e6, 5e6, 7e6, 9e6)]
TASKS = {"uplink": (uplink_cases, SHIPPED_LTE), "lte-v2": (lte_cases, LTE_V2)}
"""Episodes of each task, and the law of its links."""


def played(case: Case, planning: Planning, links: Hidden) -> list[Row]:
    """Rows of the planner and its rivals; ``planner_s`` is the time that the planner took."""
    episode = draw(case.scenario, case.seed)
    plan = QueueTask().best(episode, case.capacity, case.scenario)
    planner = CausalPlanner(planning, links, case.scenario, case.capacity, case.seed)
    key = {"scenario": case.label, "trace": case.trace, "seed": case.seed, "capacity": case.capacity}
    rows = []
    for policy in (Policy(NAME, planner.on_arrival), *map(policies.get, RIVALS)):
        began_s = time.process_time()
        result = outcome(run(policy, [episode], case.capacity, case.scenario.value), 0)
        spent_s = time.process_time() - began_s
        row = {**key, "policy": policy.name, **asdict(result), **columns(policy, result.qoi, plan)}
        rows.append({**{name: row[name] for name in RUNS}, "planner_s": spent_s if policy.name == NAME else 0.0})
    return rows


def standing(rows: Sequence[Row], decisions: int) -> list[str]:
    """The table of all policies, and what a decision of the planner took."""
    measured = scores(rows, against="learned").standings
    lines = [
        [s.policy, *(written(s[key], form) for key, form in (("score", ".3f"), ("share", ".3f"), ("against", "+.3f")))]
        for s in measured
    ]
    spent_s = sum(row["planner_s"] for row in rows)
    heads = ["policy", "score", "share of AFR's regret", "share, less learned's"]
    return [*table(heads, lines), "", f"{1e3 * spent_s / decisions:.1f} ms a decision of the planner"]


def main(
    task: Literal["uplink", "lte-v2"] = "uplink",
    capacities: Capacities = (),
    episodes: Natural = 0,
    futures: Count = 32,
    horizon_s: Positive = 20.0,
    untold: bool = False,
    out: Path = Path("results/causal-planner"),
) -> None:
    """Score the planner beside rules and `learned`, with paired 95 % intervals over links (of uplink over episodes).

    Args:
        task: train.py's held-out episodes of Uplink-v0, or the test split of lte-v2, one episode on each link.
        capacities: L; by default the task's.
        episodes: number of episodes of uplink, of links of lte-v2; 0: all.
        futures: number of futures drawn.
        horizon_s: how far they reach, s.
        untold: whether the planner does not know when the stream ends.
        out: folder for the rows; a run goes on where it was stopped.
    """
    cases, law = TASKS[task]
    planning = Planning(futures, horizon_s, not untold)
    links = prior(law, np.random.default_rng(0))
    folder = out / f"{task}-{futures}-{horizon_s:g}s-{'untold' if untold else 'told'}"
    folder.mkdir(parents=True, exist_ok=True)
    rows, decisions = [], 0
    for case in cases(capacities, episodes):
        file = folder / f"{case.label or task}-{case.capacity}-{case.seed}.csv"
        if not file.exists():
            write_rows(played(case, planning, links), file)
        rows += read_rows(file)
        decisions += case.scenario.max_messages
    publish("\n".join(standing(rows, decisions)), None)


if __name__ == "__main__":
    command(main)
