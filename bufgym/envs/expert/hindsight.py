"""The clairvoyant as an expert: the value of every action in the state that an environment is in."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.envs.expert.experts import rows_of
from bufgym.envs.fleet_rows import FleetRows
from bufgym.ground.errors import BufgymError
from bufgym.oracle.ahead import NO_ROOM, Ahead, find_steps
from bufgym.oracle.from_queue import find_values, new_work
from bufgym.oracle.programme import find_idle
from bufgym.sim.state import ARRIVAL_WAITS

_TIE = 1e-9  # Values closer than this are equal: they sum the same gaps in another order

_ROOM = 1 << 16
"""Initial room, in steps of 20 bytes each; it grows as needed."""


class Clairvoyant:
    """Knows the whole link and workload of every episode of one queue that decides at every arrival.

    Values are exact for equal sizes; other sizes raise a BufgymError. An arrival that asks for no decision counts as
    one that could be rejected. Values are upper bounds where that matters, which is never the case in an interruption.
    """

    def __init__(self, env: Any) -> None:
        self.rows = rows_of(env)
        senders = self.rows.senders
        if senders.topics or isinstance(self.rows, FleetRows):
            what = "several topics" if senders.topics else "robots that share a link"
            raise BufgymError(f"expert.clairvoyant: known for one queue with a link of its own, not for {what}")
        if senders.decide_at != "arrival":
            raise BufgymError(f"expert.clairvoyant: decide_at = {senders.decide_at!r}: must be 'arrival'")
        n, messages = len(self.rows), senders.batch.arrivals.shape[1]
        numbers = (np.zeros((n, messages), np.int64) for _ in range(5))
        c, between, idle, begin, stop = numbers
        lead = np.zeros((n, messages))
        pool = np.zeros(_ROOM, np.int64), np.zeros(_ROOM), np.zeros(_ROOM, np.int32)
        self._ahead = Ahead(c, between, idle, np.zeros((n, 3), np.int64), begin, stop, lead, *pool)
        self._steps = [np.zeros((2, 64), array.dtype) for array in pool]
        self._span = np.zeros((n, 2), np.int64)  # each row's part of the pool
        self._end = 0
        self._begun = np.zeros(n, np.int64)
        self._work = new_work(self.rows.capacity, messages)

    def values(self) -> NDArray[np.float64]:
        """float64[n, L + 2]: the best H still attainable after each action, in hindsight.

        NaN for invalid actions, and where no decision is due.
        """
        senders = self.rows.senders
        due = senders.batch.senders["waiting"] == ARRIVAL_WAITS
        for i in np.flatnonzero(due & (self._begun != senders.begun)).tolist():
            self._load(i)
        values = np.empty((len(self.rows), self.rows.capacity + 2))
        find_values(senders.batch, self._ahead, self._work, self.rows.output.action_mask, values)
        return values

    def regrets(self) -> NDArray[np.float64]:
        """float64[n, L + 2]: the part of H that each action gives up for good, 0 for the best; NaN as in ``values``."""
        values = self.values()
        most = np.where(np.isnan(values), -np.inf, values).max(axis=1, keepdims=True)
        return np.asarray(most - values)

    def actions(self) -> NDArray[np.int64]:
        """int64[n]: a best action (ties: accept, then reject, then the oldest slot), L where no decision is due."""
        values, L = self.values(), self.rows.capacity
        order = np.array([L + 1, L, *range(L)])
        known = np.where(np.isnan(values), -np.inf, values)[:, order]
        chosen = order[np.argmax(known >= known.max(axis=1, keepdims=True) - _TIE, axis=1)]
        return np.asarray(np.where(np.isnan(values).all(axis=1), L, chosen), np.int64)

    def _load(self, i: int) -> None:
        """Compute the steps of row ``i``'s episode."""
        senders = self.rows.senders
        episode = senders.episodes[i]
        assert episode is not None
        arrivals = np.asarray(episode.arrivals)
        size = np.ascontiguousarray(arrivals["size_bytes"])
        b, n = int(size[0]), len(arrivals)
        if (size != b).any():
            raise BufgymError(
                f"expert.clairvoyant: row {i}: messages of {size.min()} to {size.max()} bytes: for equal sizes only"
            )
        if episode.window != 1 or episode.ack_delay_us:
            raise BufgymError(f"expert.clairvoyant: row {i}: the socket waits for acks: only known where it does not")
        room = min(senders.capacity, senders.max_bytes // b)
        ahead = self._ahead
        ahead.link[i] = b, room, episode.link.carries_bytes
        ahead.c[i, :n] = episode.link.carried_by(arrivals["arrival_us"])
        limit = np.full(n, room * b if room else -1)
        find_idle(ahead.c[i, :n], size, limit, limit, ahead.between[i, :n], ahead.idle[i, :n])
        self._span[i] = 0
        while (end := find_steps(senders.batch, self._ahead, i, self._end, *self._steps)) < 0:
            if end == NO_ROOM:
                self._make_room()
            else:
                self._steps = [np.zeros((2, 2 * steps.shape[1]), steps.dtype) for steps in self._steps]
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
