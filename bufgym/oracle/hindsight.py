"""The clairvoyant at every decision of n senders: the best H still attainable, with each action and at all."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.oracle.ahead import NO_ROOM, Ahead, find_steps, new_rivals
from bufgym.oracle.from_queue import find_most, find_values, new_work
from bufgym.oracle.programme import find_idle
from bufgym.sim import Senders
from bufgym.sim.state import ARRIVAL_WAITS, NOTHING_WAITS
from bufgym.utils.errors import BufgymError

_ROOM = 1 << 16
"""Initial room, in steps of 20 bytes each; it grows as needed."""


class Hindsight:
    """Knows the whole link and workload of every episode that ``senders``, of one queue each, are in.

    Values are exact for equal sizes where every arrival asks for a decision; other sizes raise a BufgymError. An
    arrival that asks for no decision counts as one that could be rejected. So values are upper bounds where that
    matters: under ``decide_at="overflow"``, and never in an interruption.
    """

    def __init__(self, senders: Senders, who: str) -> None:
        """Errors begin with ``who`` asks."""
        if senders.topics:
            raise BufgymError(f"{who}: known for one queue with a link of its own, not for several topics")
        self.senders, self._who = senders, who
        n, messages = len(senders), senders.batch.arrivals.shape[1]
        numbers = (np.zeros((n, messages), np.int64) for _ in range(5))
        c, between, idle, begin, stop = numbers
        lead = np.zeros((n, messages))
        pool = np.zeros(_ROOM, np.int64), np.zeros(_ROOM), np.zeros(_ROOM, np.int32)
        self._ahead = Ahead(c, between, idle, np.zeros((n, 3), np.int64), begin, stop, lead, *pool)
        self._rivals = new_rivals(64)
        self._span = np.zeros((n, 2), np.int64)  # each row's part of the pool
        self._end = 0
        self._begun = np.zeros(n, np.int64)
        self._work = new_work(senders.capacity, messages)
        self._every = np.tile(np.arange(senders.capacity + 2), (n, 1))
        self._values = np.empty(self._every.shape)
        self._most = np.zeros(n)

    def values(self, decisions: NDArray[np.int64] | None = None) -> NDArray[np.float64]:
        """float64[n, m]: the best H attainable in hindsight after each of the ``decisions``, int64[n, m].

        A decision is a slot to evict, L to reject, L + 1 to accept; by default each of these. NaN for invalid and other
        decisions, and where no decision is due. The next call may write the array again.
        """
        self._load_begun()
        decisions = self._every if decisions is None else decisions
        if self._values.shape != decisions.shape:
            self._values = np.empty(decisions.shape)
        find_values(self.senders.batch, self._ahead, self._work, decisions, self._values)
        return self._values

    def most(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """float64[n]: at ``rows`` the best H still attainable in hindsight, 0 where no decision is due.

        Other entries are those of an earlier call. The next call writes the array again.
        """
        self._load_begun()
        find_most(self.senders.batch, self._ahead, self._work, rows, self._most)
        return self._most

    def at_start(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """float64[n]: likewise of whole episodes, in ``rows`` that have loaded them and not begun to play."""
        waiting = self.senders.batch.senders["waiting"]
        waiting[rows] = ARRIVAL_WAITS  # the first arrival finds an empty queue: any decision may be made about it
        most = self.most(rows)
        waiting[rows] = NOTHING_WAITS
        return most

    def _load_begun(self) -> None:
        """Compute the steps of episodes that have begun and ask for their first decision."""
        senders = self.senders
        due = senders.batch.senders["waiting"] == ARRIVAL_WAITS
        for i in np.flatnonzero(due & (self._begun != senders.begun)).tolist():
            self._load(i)

    def _load(self, i: int) -> None:
        """Compute the steps of row ``i``'s episode."""
        senders = self.senders
        episode = senders.episodes[i]
        assert episode is not None
        arrivals = np.asarray(episode.arrivals)
        size = np.ascontiguousarray(arrivals["size_bytes"])
        b, n = int(size[0]), len(arrivals)
        if (size != b).any():
            raise BufgymError(
                f"{self._who}: row {i}: messages of {size.min()} to {size.max()} bytes: for equal sizes only"
            )
        if episode.window != 1 or episode.ack_delay_us:
            raise BufgymError(f"{self._who}: row {i}: the socket waits for acks: only known where it does not")
        room = min(senders.capacity, senders.max_bytes // b)
        ahead = self._ahead
        ahead.link[i] = b, room, episode.link.carries_bytes
        ahead.c[i, :n] = episode.link.carried_by(arrivals["arrival_us"])
        limit = np.full(n, room * b if room else -1)
        find_idle(ahead.c[i, :n], size, limit, limit, ahead.between[i, :n], ahead.idle[i, :n])
        self._span[i] = 0
        while (end := find_steps(senders.batch, self._ahead, i, self._end, self._rivals)) < 0:
            if end == NO_ROOM:
                self._make_room()
            else:
                self._rivals = new_rivals(2 * len(self._rivals.message))
        self._span[i], self._end = (self._end, end), end
        self._begun[i] = senders.begun[i]

    def _make_room(self) -> None:
        """Close the gaps left by past episodes; double the room if they were less than half of it."""
        old, kept = self._ahead, int(np.diff(self._span).sum())
        room = len(old.latest) * (1 if 2 * (self._end - kept) > len(old.latest) else 2)
        pool: list[NDArray[Any]] = [np.zeros(room, array.dtype) for array in (old.latest, old.gain, old.follow)]
        self._end = 0
        for i, (begin, stop) in enumerate(self._span.tolist()):
            place = slice(self._end, self._end + stop - begin)
            pool[0][place], pool[1][place] = old.latest[begin:stop], old.gain[begin:stop]
            pool[2][place] = old.follow[begin:stop]
            old.begin[i] += self._end - begin
            old.stop[i] += self._end - begin
            self._span[i] = place.start, place.stop
            self._end = place.stop
        self._ahead = old._replace(latest=pool[0], gain=pool[1], follow=pool[2])
