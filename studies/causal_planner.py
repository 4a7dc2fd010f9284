"""How much is left for an agent that does not know the future? A slow planner that knows the laws tells.

    python -m studies.learned --planner --only task,lte

At every arrival the planner takes the action that is best on average over futures of link and motion, drawn from their
laws given what the robot has seen (``studies.futures``). The value of an action in one future is the clairvoyant's: the
best H attainable from the present queue with that future known. This is hindsight planning (Chong, Givan and Chang
2000), also called QMDP. It is a policy, so its score can be reached, and a better policy may exist: it decides as if
the future were told right after the decision.

With room in the queue accepting costs the clairvoyant nothing, so values are often equal. Of equal actions it takes the
one of ``target-gap``, else it accepts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.families import Run
from bufgym import policies
from bufgym.model.buffer import ACCEPT, REJECT, Buffer
from bufgym.model.link import FOREVER
from bufgym.oracle.ahead import NO_ROOM, Ahead, find_steps, new_rivals
from bufgym.oracle.from_queue import find_values, new_work
from bufgym.oracle.programme import find_idle
from bufgym.policies import Policy
from bufgym.scenario import Uplink
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.sim.state import ARRIVAL_WAITS, new_batch
from bufgym.traces.generate.lte import LTE_MODES
from bufgym.traces.shipped import SHIPPED_LTE
from studies.futures import DriveSeen, Hidden, Links, LinkSeen, rates

NAME = "causal-planner"
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


LTE_V2: Links = [(mode, mean) for mode in LTE_MODES for mean in (3e6, 5e6, 7e6, 9e6)]
LAWS: dict[str, Links] = {"task": SHIPPED_LTE, "lte": LTE_V2}
"""The law of the links of two families of ``studies.families``."""


def qoi_of(run_: Run, planning: Planning, links: Hidden, seed: int) -> float:
    """H of the planner on a run; ``links`` are drawn from the law of its link, and ``seed`` draws the futures."""
    planner = CausalPlanner(planning, links, run_["scenario"], run_["capacity"], seed)
    senders = run(Policy(NAME, planner.on_arrival), [run_["episode"]], run_["capacity"], run_["value"])
    return outcome(senders, 0).qoi
