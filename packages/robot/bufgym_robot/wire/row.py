"""A sender that learns of its messages and its link as they happen: one row of the simulator's batch.

See docs/methods.md, "A live run is a simulation".
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import Repeated
from bufgym.model.link import Link
from bufgym.model.qoi import Value
from bufgym.model.topics import Topic
from bufgym.policies.registry import Policy
from bufgym.scenario import Episode, messages
from bufgym.sim import Senders
from bufgym.sim.rollout import python_rollout, rollout
from bufgym.sim.state import CARRIES, NOT_YET, Batch
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError

ROOM = 2**16  # Columns of a new row, 7 MB. After this many messages the settled ones are forgotten.


def refuse_rivals(policy: Policy) -> None:
    """Raise for a policy that sees the future or ignores L, which no live queue can."""
    if policy.unbounded or policy.privileged is not None:
        raise BufgymError(f"policy {policy.name}: {policy.unranked_because}: no policy for a live queue")


class LiveRow:
    """One sender under one policy. Times never fall between calls, and rise at a knot."""

    def __init__(
        self,
        policy: Policy,
        capacity: int,
        value: Value,
        *,
        max_bytes: int | None = None,
        decide_at: str = "arrival",
        topics: Sequence[Topic] = (),
        window: int = 1,
        ends_us: int | None = None,
        room: int = ROOM,
    ) -> None:
        refuse_rivals(policy)
        self.policy = policy
        self.value = value
        self.senders = Senders(
            1, capacity, value, max_messages=room, max_bytes=max_bytes, decide_at=decide_at, topics=topics
        )
        # A dummy episode resets the row; its link has two knots and carries nothing.
        nothing = Trace("live", np.array([0, 1]), np.array([0, 0]), "stop")
        self.senders.load(0, Episode(messages(np.array([0]), 1), Link(nothing), window=window, ends_us=ends_us))
        self.senders.follow(policy)
        self.memory = policy.new_memory(1, self.senders.capacity)
        self._again = Repeated()
        self._use(self.senders.batch, room)

    def _use(self, batch: Batch, room: int) -> None:
        """Switch to these arrays; columns of future messages are free."""
        self.batch = self.senders.batch = batch._replace(parameters=self.policy.parameter_array)
        self.sender = batch.senders[0]
        self.room = self.sender["arrivals"] = room
        batch.arrivals["arrival_us"][0, self.sender["next"] :] = NOT_YET
        self._first_knot = int(self.sender["first_knot"])

    def put(self, now_us: int, size_bytes: int, x: float, topic: int, uniform: float) -> int:
        """Add a message; return its ``seq``."""
        if self.sender["next"] + 1 >= self.room:
            self._make_room()
        sender = self.sender
        place = int(sender["next"])
        seq = place + int(sender["first_seq"])
        self.batch.arrivals[0, place] = (seq, now_us, size_bytes, topic, x, uniform, 0.0)
        self._advance()
        return seq

    def carried(self, now_us: int, left_bytes: int | None) -> int:
        """Note that the link has ``left_bytes`` of the socket still to carry; return the bytes carried so far.

        None means unknown. A message has left only when ``gone`` says so; until then at least one byte of it is left.
        """
        position = self._knot_bytes
        if left_bytes is not None and self.sender["link"] == CARRIES:
            end = int(self.sender["position"])
            position = max(position, min(end - 1, end + self._waiting_bytes - left_bytes))
        self._tell(now_us, position)
        return position

    def gone(self, now_us: int) -> int:
        """Note that the oldest message in the socket has left; return the bytes carried so far."""
        if self.sender["link"] != CARRIES:
            raise BufgymError("no message is in transmission: none can have left")
        self._tell(now_us, int(self.sender["position"]))
        self.sender["finish_us"] = now_us
        self._advance()
        return self._knot_bytes

    def close(self) -> None:
        """Note that no message follows."""
        self.sender["arrivals"] = self.sender["next"]
        self._advance()

    @property
    def queued(self) -> list[int]:
        """List ``seq`` of the queued messages, the oldest first."""
        first = int(self.sender["first"])
        seqs: list[int] = self.batch.slots["seq"][0, first : first + self.occupancy].tolist()
        return seqs

    @property
    def occupancy(self) -> int:
        """Messages queued."""
        return int(self.sender["occupancy"])

    @property
    def dequeued(self) -> int:
        """Messages that the socket has dequeued so far."""
        return int(self.sender["dequeued"]) + int(self.sender["forgotten"])

    def dequeued_seq(self, number: int) -> int:
        """Find ``seq`` of the ``number``-th dequeued message, from 0; it must be a recent one."""
        place = self.batch.order[0, number - int(self.sender["forgotten"])]
        return int(place) + int(self.sender["first_seq"])

    def limited(self, seq: int) -> bool:
        """Whether a rate limit dropped this message, which must be recent."""
        return bool(self.batch.log["limited"][0, seq - int(self.sender["first_seq"])])

    @property
    def _knot_bytes(self) -> int:
        """Bytes that the link has carried by the last knot."""
        return int(self.batch.knot_bytes[self._first_knot + 1])

    @property
    def _waiting_bytes(self) -> int:
        """Bytes of messages in the socket that the link has not begun to carry."""
        waiting = self.batch.order[0, int(self.sender["transmitted"]) + 1 : int(self.sender["dequeued"])]
        return int(self.batch.arrivals["size_bytes"][0, waiting].sum())

    def _advance(self) -> None:
        """Process everything that is due."""
        policy = self.policy
        if policy.compile:
            self._again(rollout, self.batch, None, self.memory, *policy.compiled, policy.hears_departures)
        else:
            python_rollout(self.batch, None, self.memory, policy)

    def _tell(self, now_us: int, position: int) -> None:
        """Add a knot; the simulator looks up only the last two."""
        here = self._first_knot
        us, size = self.batch.knot_us, self.batch.knot_bytes
        us[here], size[here] = us[here + 1], size[here + 1]
        us[here + 1], size[here + 1] = now_us, position

    def _make_room(self) -> None:
        """Forget settled messages; if they are too few, double the columns."""
        sender, batch = self.sender, self.batch
        # The last dequeued message and the last two arrivals stay, because a policy may look back.
        dequeues = max(0, int(sender["credited"]) - 1)
        kept = batch.order[0, dequeues : int(sender["dequeued"])].tolist()
        queued = [seq - int(sender["first_seq"]) for seq in self.queued]
        columns = max(0, min([*kept, *queued, int(sender["next"]) - 2]))
        for array, shift in ((batch.arrivals, columns), (batch.log, columns), (batch.order, dequeues)):
            array[0, : array.shape[1] - shift] = array[0, shift:].copy()
        batch.order[0] -= columns
        sender["first_seq"] += columns
        sender["forgotten"] += dequeues
        sender["next"] -= columns
        for count in ("dequeued", "transmitted", "credited", "acked"):
            sender[count] -= dequeues
        room = self.room
        if columns < room // 2:
            room *= 2
            batch = batch._replace(
                arrivals=_wider(batch.arrivals, room), log=_wider(batch.log, room), order=_wider(batch.order, room)
            )
        self._use(batch, room)


def _wider(array: NDArray[Any], columns: int) -> NDArray[Any]:
    """Extend the row to this many columns with zeros."""
    wide: NDArray[Any] = np.zeros_like(array, shape=(1, columns))
    wide[:, : array.shape[1]] = array
    return wide
