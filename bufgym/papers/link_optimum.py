"""The online optimum over a small link, for a policy that knows the link's law but not its future.

A message arrives each period. In a period the link carries 0, 1/4, 1/2 or one message, as a Markov chain (``Chain``)
decides. V is constant from a distance D on, so a gap counts as one of 1..D. The state at an arrival is

    how many messages wait (n <= L), the gap of each to the one before it, and that of the newcomer to the tail,
    how many quarters of the message in the socket are left (0: the socket is idle), and the rate of the last period.

This is small enough for an exact dynamic programme, backwards from the last arrival, after which all waiting messages
are sent. A policy on board knows the whole state while the socket is busy, as the rate shows in the bytes that left. An
idle socket takes the newcomer at once (``asked="busy"``). ``asked="always"`` decides there too and is told the rate, to
bound the possible gain. ``asked="full"`` accepts whenever there is room.

A queue of n messages has the number first[n] + (its n + 1 gaps less 1, the oldest first, as digits to the base D). So
the head leaves by a modulo. After a decision the last digit is the time since the last accepted arrival.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.errors import BufgymError
from bufgym.ground.kernel import interruptible, kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer
from bufgym.model.checks import whole
from bufgym.model.qoi import Value, tabulated
from bufgym.policies.registry import Policy

QUARTERS = np.array([0, 1, 2, 4])
"""Quarters of a message that the link carries in a period, by state of the chain."""
MESSAGE = 4
"""Quarters of a message."""
ASKED = ("full", "busy", "always")
"""When a decision is asked for: at a full queue, at a busy socket, at each arrival."""
_MOST = 2**30
"""Most decisions to keep."""


@dataclass(frozen=True)
class Chain:
    """The link's rate stays from one period to the next, or becomes one of the others with equal probability."""

    stays: float = 0.9
    """Probability that the rate stays."""

    def __post_init__(self) -> None:
        if not 0 <= self.stays <= 1:
            raise BufgymError(f"stays = {self.stays!r}: must be a probability")

    @property
    def matrix(self) -> NDArray[np.float64]:
        """P(next state | state), [4, 4]; in the long run all four states are equally likely."""
        n = len(QUARTERS)
        return np.where(np.eye(n, dtype=bool), self.stays, (1 - self.stays) / (n - 1))

    def draw(self, periods: int, rng: np.random.Generator) -> NDArray[np.int64]:
        """Draw the states of so many periods; the state before them is uniform."""
        law, states = self.matrix.cumsum(axis=1), [int(rng.integers(len(QUARTERS)))]
        for uniform in rng.random(periods):
            states.append(min(int(np.searchsorted(law[states[-1]], uniform, side="right")), len(QUARTERS) - 1))
        return np.array(states[1:], np.int64)


def cut_off(v: Value, distance: int) -> Value:
    """V up to ``distance``, constant after it; V is read at whole distances only."""
    gaps = range(distance + 1)
    return tabulated(list(gaps), [v(float(d)) for d in gaps])


@dataclass(frozen=True, eq=False)
class SmallLink:
    """The best mean of H over episodes of so many arrivals, and the decisions that reach it."""

    capacity: int
    """L, messages."""
    gain: NDArray[np.float64]
    """V(0..D)."""
    value: float
    """E[H] of the optimum."""
    decisions: NDArray[np.int8] = field(repr=False)
    """[arrivals to come, queue, quarters left, state]: a slot, REJECT or ACCEPT. Decisions far from the end no longer
    change, so the last entry serves for all of them."""
    arrivals: int
    """Arrivals of an episode."""

    def decide(self, number: int, gaps: list[int], left: int, state: int) -> int:
        """The decision at arrival ``number`` (from 0), for the gaps of the queued messages and of the newcomer."""
        depth, code = len(self.gain) - 1, 0
        for gap in gaps:
            code = code * depth + min(gap, depth) - 1
        to_come = min(self.arrivals - 1 - number, len(self.decisions) - 1)
        return int(self.decisions[to_come, _first(depth, self.capacity)[len(gaps) - 1] + code, left, state])

    def policy(self) -> Policy:
        """The optimum as a policy, for the episodes of this chain; it runs uncompiled."""
        return Policy("online-optimum", self._on_arrival, source="dynamic programme, exact", reads_rate=True)

    def _on_arrival(self, buffer: Buffer, arrival: Any, memory: NDArray[np.float64]) -> int:
        """Does what the exact dynamic programme over the link's unknown future does."""
        if not buffer.busy:
            return ACCEPT
        x = [buffer.dequeued_x, *buffer.slots["x"].tolist(), arrival.x]
        quarter = arrival.size_bytes / MESSAGE
        left, state = round(buffer.left_bytes / quarter), round(buffer.drained_bytes / quarter)
        return self.decide(
            int(arrival.seq), [round(gap) for gap in np.diff(x)], left, int(np.argmax(state == QUARTERS))
        )


def small_link(
    capacity: int, v: Value, chain: Chain, *, arrivals: int, depth: int = 8, kept: int = 24, asked: str = "busy"
) -> SmallLink:
    """Solve for L = ``capacity`` and episodes of so many ``arrivals``; V is cut off at D = ``depth``.

    Args:
        kept: number of arrivals to come for which decisions are kept.
        asked: one of ``ASKED``.
    """
    L, D, T = whole("capacity", capacity, 1, symbol="L"), whole("depth", depth, 1), whole("arrivals", arrivals, 1)
    first = _first(D, L)
    shape = int(first[-1]), MESSAGE + 1, len(QUARTERS)
    kept = min(whole("kept", kept, 1), T)
    if asked not in ASKED:
        raise BufgymError(f"small link: asked = {asked!r}: must be one of {', '.join(ASKED)}")
    if kept * np.prod([float(n) for n in shape]) > _MOST:
        raise BufgymError(f"small link: L = {L}, depth = {D}, kept = {kept}: too many states")
    gain = np.array([v(float(d)) for d in range(D + 1)])
    behind, ahead = np.zeros(shape), np.zeros(shape)
    decisions = np.zeros((kept, *shape), np.int8)
    _end(gain, first, behind)
    matrix = chain.matrix

    def solve() -> None:
        for to_come in range(T):
            if to_come:
                _carry(gain, first, matrix, ahead, behind)
            _decide(gain, first, ASKED.index(asked), behind, ahead, decisions[min(to_come, kept - 1)])

    interruptible(solve)
    # Message 0 adds the 1 in H, and the idle socket takes it.
    return SmallLink(L, gain, 1.0 + float(behind[first[0], MESSAGE].mean()), decisions, T)


def _first(depth: int, capacity: int) -> NDArray[np.int64]:
    """Numbers of the first queue with 0, 1, ..., L messages, then the number of all queues."""
    return np.cumsum([0] + [depth ** (n + 1) for n in range(capacity + 1)])


@kernel
def _end(gain: NDArray[np.float64], first: NDArray[np.int64], behind: NDArray[np.float64]) -> None:
    """Fill ``behind`` for the last decision, after which all waiting messages are sent."""
    D = len(gain) - 1
    for n in range(len(first) - 1):
        for code in range(first[n + 1] - first[n]):
            gained, digits = 0.0, code // D
            for _ in range(n):
                gained += gain[digits % D + 1]
                digits //= D
            behind[first[n] + code] = gained


@kernel
def _carry(
    gain: NDArray[np.float64],
    first: NDArray[np.int64],
    matrix: NDArray[np.float64],
    ahead: NDArray[np.float64],
    behind: NDArray[np.float64],
) -> None:
    """Compute ``behind`` each decision from ``ahead`` of the next; the link carries its rate in the period between."""
    D = len(gain) - 1
    for n in range(len(first) - 1):
        head = (first[n + 1] - first[n]) // D  # the oldest gap's place value
        for code in range(first[n + 1] - first[n]):
            for left in range(MESSAGE + 1):
                if left == 0 and n > 0:
                    continue
                for state in range(len(QUARTERS)):
                    behind[first[n] + code, left, state] = 0.0
                for rate in range(len(QUARTERS)):
                    quarters, rest, k, queue, place, gained = QUARTERS[rate], left, n, code, head, 0.0
                    while rest > 0 and quarters >= rest:
                        quarters -= rest
                        rest = 0
                        if k > 0:
                            gained += gain[queue // place + 1]
                            queue %= place
                            place //= D
                            k -= 1
                            rest = MESSAGE
                    if rest > 0:
                        rest -= quarters
                    worth = gained + ahead[first[k] + queue, rest, rate]
                    for state in range(len(QUARTERS)):
                        behind[first[n] + code, left, state] += matrix[state, rate] * worth


@kernel
def _decide(
    gain: NDArray[np.float64],
    first: NDArray[np.int64],
    asked: int,
    behind: NDArray[np.float64],
    ahead: NDArray[np.float64],
    decisions: NDArray[Any],
) -> None:
    """Compute ``ahead`` of each decision, and the decision; ties prefer ACCEPT, then the oldest slot."""
    L, D = len(first) - 2, len(gain) - 1
    for n in range(L + 1):
        for code in range(first[n + 1] - first[n]):
            newest = code % D
            rejected = first[n] + code - newest + min(newest + 1, D - 1)
            for left in range(MESSAGE + 1):
                if left == 0 and n > 0:
                    continue  # the socket is idle only where nothing waits
                for state in range(len(QUARTERS)):
                    best, chosen = -1.0, REJECT
                    if n < L and left > 0:
                        best, chosen = behind[first[n + 1] + code * D, left, state], ACCEPT
                    elif n < L:  # the idle socket takes the newcomer at once
                        best, chosen = gain[newest + 1] + behind[first[0], MESSAGE, state], ACCEPT
                    if n == L or asked == 2 or (asked == 1 and left > 0):
                        place = (first[n + 1] - first[n]) // D  # of the oldest gap
                        for slot in range(n):
                            gaps = code // place % D + code // (place // D) % D + 1
                            merged = code // (place * D) * D + min(gaps, D - 1)
                            place //= D
                            without = behind[first[n] + (merged * place + code % place) * D, left, state]
                            if without > best:
                                best, chosen = without, slot
                        if behind[rejected, left, state] > best:
                            best, chosen = behind[rejected, left, state], REJECT
                    ahead[first[n] + code, left, state] = best
                    decisions[first[n] + code, left, state] = chosen
