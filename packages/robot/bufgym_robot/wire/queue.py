"""A send queue ruled by a policy, for threads and for asyncio.

The program puts messages in. A transport takes out each message that the socket dequeues, and reports when it has left.

    queue = PolicyQueue("afr", capacity=8)
    queue.put(frame, len(frame))              # in the camera's callback: never blocks

    item = queue.get()                        # in the sending thread; or ``await queue.aget()``
    connection.send_and_wait_for_ack(item.message)
    queue.gone()
"""

import asyncio
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from bufgym.model import qoi
from bufgym.model.buffer import check_limits
from bufgym.model.checks import between, check_window, is_number, whole
from bufgym.model.link import MAX_TIME_US
from bufgym.model.qoi import Value
from bufgym.model.topics import Topic
from bufgym.policies.registry import Policy, get
from bufgym.utils.errors import BufgymError
from bufgym_robot.wire.log import LogFile, Record, settings
from bufgym_robot.wire.row import ROOM, LiveRow

FIRST_US: Final = 2  # Earliest time of a call; the two first knots of a link lie before it
MAX_SIZE_BYTES: Final = 2**40  # Size limit of a message; sums over months then stay within 64 bits


@dataclass(frozen=True)
class Item:
    """A message on its way to the socket."""

    message: Any
    """The object that was put."""
    seq: int
    """Index among all messages put, from 0."""
    number: int
    """Index among all messages dequeued, from 0."""
    at_us: int
    """Time of the put by the queue's clock."""
    size_bytes: int
    x: float
    topic: int


class PolicyQueue:
    """A queue of at most L = ``capacity`` messages, ruled by ``policy``. See the module's text.

    Memory holds the messages queued, at most ``window`` messages in the socket, and a few MB of bookkeeping.
    """

    def __init__(
        self,
        policy: str | Policy,
        capacity: int,
        *,
        max_bytes: int | None = None,
        value: Value | None = None,
        decide_at: str = "arrival",
        topics: Sequence[Topic] = (),
        window: int = 1,
        duration_s: float | None = None,
        log: LogFile | Callable[[Record], None] | None = None,
        seed: int | None = None,
        clock: Callable[[], float] = time.monotonic,
        room: int = ROOM,
    ) -> None:
        """Make an empty queue.

        Args:
            policy: name of a registered policy, or a ``Policy``; it must be bounded and not privileged.
            capacity: L, messages.
            max_bytes: B, bytes.
            value: V of the QoI; 1 - 0.618^d by default.
            decide_at: "arrival" or "overflow", as in the simulator.
            topics: rules of each topic, by topic number; empty for one queue without rules.
            window: n_T, most messages returned and not yet gone.
            duration_s: time from now until the stream ends, as far as it is known; messages may come later.
            log: a ``LogFile`` or any function, called with a record of each event.
            seed: seed of randomised policies' draws.
            clock: seconds; steps backwards are ignored.
            room: messages between two cleanups of the bookkeeping, at least 8.
        """
        check_limits(capacity, max_bytes)
        self.policy = get(policy)
        value = qoi.exponential() if value is None else value
        if duration_s is not None:
            between("duration_s", duration_s, 0, MAX_TIME_US / 1e6, "s")
        ends_us = None if duration_s is None else round(1e6 * duration_s)
        rules: dict[str, Any] = {"max_bytes": max_bytes, "decide_at": decide_at, "topics": topics, "ends_us": ends_us}
        rules["window"] = check_window(window)
        self._row = LiveRow(self.policy, capacity, value, room=whole("room", room, 8, 2**30), **rules)
        self.left_bytes: Callable[[], int | None] = lambda: None
        """Called at each ``put``: returns the bytes returned that have not left, None if unknown. A transport sets
        it."""
        self._topics = max(1, len(topics))
        self._one_scene = not topics
        self._clock = clock
        self._began_s = clock()
        self._now_us = FIRST_US - 1
        self._latest_x = [-math.inf] * self._topics
        self._uniforms = np.random.default_rng(seed)
        self._log = log
        self._held: dict[int, Item] = {}
        self._ready: deque[Item] = deque()
        self._away: deque[Item] = deque()
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._waiting: set[tuple[asyncio.AbstractEventLoop, asyncio.Future[None]]] = set()
        self._number = 0  # dequeued messages handed on so far
        self._closed = False
        self.dropped = 0
        """Messages dropped so far."""
        self._tell(settings(self.policy, capacity, value, **rules))

    def put(
        self, message: Any, size_bytes: int, x: float | None = None, topic: int = 0, at_us: int | None = None
    ) -> int:
        """Put a message; the policy decides at once. Returns its ``seq`` and never blocks.

        Args:
            message: any object; the queue releases it when it is dropped or has left.
            size_bytes: bytes that the link has to carry.
            x: coordinate of the scene, which must not fall; None means 1 more than the last on its topic, from 0.
            topic: index in ``topics``; any number without topics.
            at_us: time in us from any origin, for callers with their own clock.
        """
        size_bytes = whole("size_bytes", size_bytes, 1, MAX_SIZE_BYTES)
        topic = whole("topic", topic, 0, 2**31 if self._one_scene else self._topics - 1)
        with self._lock:
            if self._closed:
                raise BufgymError("the queue is closed: nothing can be put")
            scene = 0 if self._one_scene else topic
            x = self._next_x(scene, x)
            now_us = self._stamp(at_us)
            carried = self._row.carried(now_us, self._unsent())
            uniform = float(self._uniforms.random())
            with self._deciding():
                seq = self._row.put(now_us, size_bytes, x, topic, uniform)
            self._latest_x[scene] = x
            self._held[seq] = Item(message, seq, -1, now_us, size_bytes, x, topic)
            about = {"seq": seq, "size_bytes": size_bytes, "x": x, "topic": topic}
            self._tell({"event": "put", "us": now_us, **about, "uniform": uniform, "carried": carried})
            self._settle(now_us, seq)
        return seq

    def close(self) -> None:
        """Accept no more messages; queued ones are still returned, then ``get`` returns None."""
        with self._lock:
            if not self._closed:
                self._closed = True
                with self._deciding():
                    self._row.close()
                self._settle(self._stamp(None), None)

    def get(self, timeout_s: float | None = None) -> Item | None:
        """Wait for the next message that the socket dequeues; None once the queue is closed and empty.

        Raises:
            TimeoutError: there was no message for ``timeout_s``.
        """
        with self._changed:
            if not self._changed.wait_for(lambda: self._ready or self._drained, timeout_s):
                raise TimeoutError(f"no message for {timeout_s} s")
            return self._hand_out()

    async def aget(self) -> Item | None:
        """Do ``get`` for asyncio; a task cancelled here takes no message with it."""
        loop = asyncio.get_running_loop()
        while True:
            with self._lock:
                if self._ready or self._drained:
                    return self._hand_out()
                entry = loop, loop.create_future()
                self._waiting.add(entry)
            try:
                await entry[1]
            finally:
                with self._lock:
                    self._waiting.discard(entry)

    def __iter__(self) -> Iterator[Item]:
        """Iterate over ``get``; asking for the next message calls ``gone`` for the last."""
        for item in iter(self.get, None):
            yield item
            self.gone()

    def gone(self) -> None:
        """Report that the oldest message returned has left: it was acked, or all its bytes are on their way."""
        with self._lock:
            if not self._away:
                raise BufgymError("no message was returned that has not left yet")
            item = self._away.popleft()
            now_us = self._stamp(None)
            with self._deciding():
                carried = self._row.gone(now_us)
            self._tell({"event": "gone", "us": now_us, "seq": item.seq, "carried": carried})
            self._settle(now_us, None)

    def __len__(self) -> int:
        """Messages queued."""
        with self._lock:
            return len(self._held)

    @property
    def in_flight(self) -> int:
        """Messages dequeued by the socket that have not left."""
        with self._lock:
            return len(self._ready) + len(self._away)

    @property
    def _drained(self) -> bool:
        """Whether no message will be returned any more."""
        return self._closed and not self._held and not self._ready

    @contextmanager
    def _deciding(self) -> Iterator[None]:
        """End the queue if the policy raises an error, so that nobody waits for a message in vain."""
        try:
            yield
        except BaseException:
            self._closed = True
            self._held.clear()
            self._wake()
            raise

    def _stamp(self, at_us: int | None) -> int:
        """Time stamp an event, later than all before, whatever the clock does."""
        ours_us = int((self._clock() - self._began_s) * 1e6) if at_us is None else whole("at_us", at_us, 0, MAX_TIME_US)
        self._now_us = max(ours_us, self._now_us + 1)
        return self._now_us

    def _next_x(self, scene: int, x: float | None) -> float:
        """Determine the coordinate of a message; raise an error if x fell."""
        latest = self._latest_x[scene]
        if x is None:
            return 0.0 if latest == -math.inf else latest + 1
        if not is_number(x) or not math.isfinite(x) or x < latest:
            raise BufgymError(f"x = {x!r}: must be a finite number, and not less than {latest}, that before it")
        return float(x)

    def _unsent(self) -> int | None:
        """Bytes dequeued that have not left."""
        left_bytes = self.left_bytes()
        return None if left_bytes is None else left_bytes + sum(item.size_bytes for item in self._ready)

    def _hand_out(self) -> Item | None:
        if not self._ready:
            return None
        item = self._ready.popleft()
        self._away.append(item)
        return item

    def _settle(self, now_us: int, newcomer: int | None) -> None:
        """Hand on dequeued messages and release dropped ones."""
        before, self._number = self._number, self._row.dequeued
        for number in range(before, self._number):
            item = self._held.pop(self._row.dequeued_seq(number))
            self._ready.append(replace(item, number=number))
            self._tell({"event": "dequeued", "us": now_us, "seq": item.seq})
        if len(self._held) > self._row.occupancy:
            queued = set(self._row.queued)
            for seq in [seq for seq in self._held if seq not in queued]:
                del self._held[seq]
                self.dropped += 1
                self._tell({"event": "dropped", "us": now_us, "seq": seq, "why": self._why(seq, newcomer)})
        if self._number > before or self._drained:
            self._wake()

    def _why(self, seq: int, newcomer: int | None) -> str:
        if self._row.limited(seq):
            return "limited"
        if newcomer is None:
            return "dropped at the head"
        return "rejected" if seq == newcomer else f"evicted for {newcomer}"

    def _tell(self, record: Record) -> None:
        if self._log is not None:
            self._log(record)

    def _wake(self) -> None:
        self._changed.notify_all()
        here = asyncio._get_running_loop()
        for loop, future in self._waiting:
            if loop is here:
                _resolve(future)  # to wake a loop from within it takes as long as a decision
            else:
                loop.call_soon_threadsafe(_resolve, future)
        self._waiting.clear()


def _resolve(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)
