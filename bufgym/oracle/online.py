"""The online optimum: the best that any policy can do in one interruption whose length T it does not know.

See docs/methods.md, "The online optimum".
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bufgym.jit import Floats, Ints, interruptible, kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer
from bufgym.model.checks import whole
from bufgym.model.qoi import Value
from bufgym.oracle.interruption import integer
from bufgym.policies.gaps import min_gap
from bufgym.policies.registry import Policy
from bufgym.utils.errors import BufgymError

OBJECTIVES = ("ratio", "qoi")

_MOST = 2**61  # cut-off for binomial coefficients: larger ones belong to no state that fits into memory


@dataclass(frozen=True, eq=False)
class OnlineOptimum:
    """The best mean over T that a policy can reach without knowing T, and the decisions that reach it."""

    capacity: int
    """L, messages."""
    probabilities: Floats
    """float64[t_max + 1]: P(T = t) for t = 0..t_max, the longest possible length."""
    objective: str
    """One of ``OBJECTIVES``."""
    value: float
    """The optimum: mean of (H - 1) / ``oracle.integer`` for "ratio", of H - 1 for "qoi". H counts message 0."""
    decisions: NDArray[Any] = field(repr=False)
    """int[C(t_max, L + 1)], by number of the set of L + 1 messages: the one dropped (0 = oldest, L = newcomer)."""

    @property
    def t_max(self) -> int:
        """The longest interruption that the law allows, messages."""
        return len(self.probabilities) - 1

    def decision(self, positions: Sequence[int]) -> int:
        """The decision when the last of ``positions``, 1 <= p_1 < ... <= t_max, arrives and the others are queued.

        A position counts arrivals: message p is the p-th of the interruption. Returns a slot to evict (0 = oldest),
        REJECT, or ACCEPT if there is room.
        """
        if not self._knows(positions):
            raise BufgymError(
                f"positions {list(positions)}: must be 1 to {self.capacity + 1} rising numbers from 1 to {self.t_max}"
            )
        if len(positions) <= self.capacity:
            return ACCEPT
        slot = int(self.decisions[sum(math.comb(p - 1, k) for k, p in enumerate(positions, 1))])
        return slot if slot < self.capacity else REJECT

    def _knows(self, positions: Sequence[int]) -> bool:
        rising = all(a < b for a, b in itertools.pairwise(positions))
        return rising and 0 < len(positions) <= self.capacity + 1 and 1 <= positions[0] and positions[-1] <= self.t_max

    def policy(self) -> Policy:
        """The optimum as a policy for this L, in the simulator and the environments; it runs uncompiled.

        A message's position is the time from the arrival of the message dequeued last to its own, rounded to periods by
        their running mean. Sequence numbers would do in ``Interruption`` alone; times also fit a link that stops in
        mid-stream. Min-gap decides for a full queue that the table lacks (an arrival after t_max, two messages in one
        period). A buffer with another L is an error.
        """
        name = f"online-optimum:L={self.capacity}"
        return Policy(name, self._on_arrival, source="dynamic programme, exact", built_in=True)

    def _on_arrival(self, buffer: Buffer, arrival: Any, memory: Floats) -> int:
        """A full queue drops what the exact dynamic programme over the unknown length T drops."""
        if buffer.capacity != self.capacity:
            raise BufgymError(f"online-optimum: made for L = {self.capacity}, but the buffer has L = {buffer.capacity}")
        if len(buffer.slots) < self.capacity:
            return ACCEPT
        if buffer.period_us > 0:
            times_us = [*buffer.slots["arrival_us"].tolist(), int(arrival.arrival_us)]
            positions = [round((us - int(buffer.dequeued_arrival_us)) / float(buffer.period_us)) for us in times_us]
            if self._knows(positions):
                return self.decision(positions)
        return min_gap(buffer, arrival, memory)


def online_optimum(
    capacity: int, probabilities: ArrayLike, v: Value, *, objective: str = "ratio", max_states: int = 50_000_000
) -> OnlineOptimum:
    """Solve for L = ``capacity`` and P(T = t), t = 0, 1, ... (such as ``law(scenario)``).

    ``objective`` is "ratio" for the mean of (H - 1) / ``oracle.integer``, or "qoi" for the mean of H - 1. There are
    C(t_max + 1, L + 1) states of at most 9 bytes each; more than ``max_states`` raise a BufgymError.
    """
    L, p = whole("capacity", capacity, 1, symbol="L"), _checked(probabilities)
    if not isinstance(v, Value):
        raise BufgymError(f"v = {v!r}: must be a bufgym.model.qoi Value, such as qoi.exponential(0.618)")
    if objective not in OBJECTIVES:
        raise BufgymError(f"objective = {objective!r}: must be one of {', '.join(OBJECTIVES)}")
    t_max = len(p) - 1
    _check_states(L, t_max, max_states)
    weight = p / [integer(L, t, v) for t in range(t_max + 1)] if objective == "ratio" else p
    gain = np.array([v(d) for d in range(t_max + 2)])
    value = math.fsum(weight[t] * (t + 1) * gain[1] for t in range(min(L, t_max + 1)))  # room for all
    decisions = np.zeros(math.comb(t_max, L + 1), np.min_scalar_type(L))
    if t_max >= L:
        best, work = np.empty(math.comb(t_max, L)), np.zeros(L + 2, np.int64)
        binomials = np.ones((t_max + 1, L + 2), np.int64)  # C(n, k), int64[t_max + 1, L + 2]
        binomials[0, 1:] = 0
        for n in range(1, t_max + 1):
            binomials[n, 1:] = np.minimum(_MOST, binomials[n - 1, 1:] + binomials[n - 1, :-1])
        interruptible(lambda: _solve(gain, weight, binomials, work, best, decisions))
        value += best[0]  # the set of messages 1..L
    for array in (p, decisions):
        array.flags.writeable = False
    return OnlineOptimum(L, p, objective, float(value), decisions)


@kernel
def _solve(gain: Floats, weight: Floats, binomial: Ints, kept: Ints, best: Floats, decisions: NDArray[Any]) -> None:
    """Fill ``best`` and ``decisions`` backwards from t_max arrivals to L; ties drop the oldest.

    ``gain`` is V(0..t_max + 1), ``weight`` the weight of each T = t, and ``binomial[n, k]`` = C(n, k). ``kept``,
    int64[L + 2], is work space for message 0, the queued ones, and the one sent after. ``best[r]`` is the expected gain
    to come with the queued set number r, times the probability of having come so far.
    """
    t_max, L = len(weight) - 1, len(kept) - 2
    for t in range(t_max, L - 1, -1):
        for k in range(L + 1):
            kept[k] = k
        kept[L + 1] = t + 1
        for r in range(binomial[t, L]):
            gained = 0.0
            for k in range(L + 1):
                gained += gain[kept[k + 1] - kept[k]]
            later = 0.0
            if t < t_max:
                # The number of the next set, with message t + 1: messages after the evicted one move up a place.
                evicted = binomial[t, L]
                for k in range(2, L + 1):
                    evicted += binomial[kept[k] - 1, k - 1]
                later, slot = best[evicted], 0
                for k in range(1, L):
                    evicted += binomial[kept[k] - 1, k] - binomial[kept[k + 1] - 1, k]
                    if best[evicted] > later:
                        later, slot = best[evicted], k
                if best[r] > later:
                    later, slot = best[r], L
                decisions[binomial[t, L + 1] + r] = slot
            best[r] = weight[t] * gained + later
            # The next set in colexicographic order.
            k = 1
            while k < L and kept[k] + 1 == kept[k + 1]:
                kept[k] = k
                k += 1
            kept[k] += 1


def _checked(probabilities: ArrayLike) -> Floats:
    """Copy without the impossible lengths at the end; BufgymError if these are no probabilities."""
    try:
        p = np.array(probabilities, np.float64)
    except (TypeError, ValueError):
        raise BufgymError(f"probabilities = {probabilities!r}: must be numbers P(T = 0), P(T = 1), ...") from None
    if p.ndim != 1 or len(p) == 0:
        raise BufgymError(f"probabilities of shape {p.shape}: must be a list P(T = 0), P(T = 1), ... of at least one")
    wrong = np.flatnonzero(~(np.isfinite(p) & (p >= 0)))
    if len(wrong):
        raise BufgymError(f"probabilities: P(T = {wrong[0]}) = {p[wrong[0]]:g}: must be a number >= 0")
    total = math.fsum(p)
    if abs(total - 1) > 1e-9:
        raise BufgymError(f"probabilities add up to {total:.12g}: must add up to 1")
    return p[: np.flatnonzero(p)[-1] + 1].copy()


def _check_states(L: int, t_max: int, max_states: int) -> None:
    if t_max < L:
        return
    # By logarithms first: the exact number can have a hundred thousand digits.
    log10 = (math.lgamma(t_max + 2) - math.lgamma(L + 2) - math.lgamma(t_max - L + 1)) / math.log(10)
    if log10 > 18 or math.comb(t_max + 1, L + 1) > max_states:
        states = f"about 10^{log10:.0f}" if log10 > 18 else str(math.comb(t_max + 1, L + 1))
        raise BufgymError(f"online optimum: L = {L}, T up to {t_max}: {states} states: max_states = {max_states}")
