"""A relay's client for robots and other Python programs: publishes through a policy's queue, and subscribes.

    client = RobotClient("ws://relay.example:7420", "robot-3", topics=(Topic("/robots/robot-3/camera"),), policy="afr")
    client.subscribe("^/robots/robot-3/command$", on_command, durable=True)
    running = asyncio.create_task(client.run())  # connects, and again whenever the connection breaks
    client.publish("/robots/robot-3/camera", jpeg, encoding="jpeg")  # never blocks; the policy decides what goes
    await client.command("/robots/robot-4/command", {"command": "stop"})  # returns once the robot has done it

Little waits outside the queue: the next message is chosen when the system has sent nearly all of the last one,
whatever is still in flight. With ``window`` at most so many messages are on their way, as at Robofleet's client (Sec.
III-B). A message is on its way until the relay has answered the PING behind it with its PONG. After a reconnect,
messages still on their way are sent again under their original numbers.
"""

import asyncio
import contextlib
import ssl
import time
from collections import Counter, deque
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from typing import Any

from bufgym.model.qoi import Value
from bufgym.model.topics import Topic
from bufgym.policies.registry import Policy
from bufgym.utils.errors import BufgymError
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.log import Record
from bufgym_robot.wire.queue import Item, PolicyQueue
from bufgym_robot.wire.session import Session
from bufgym_robot.wire.sockets import unsent_bytes, until_writable


@dataclass(eq=False)
class _Away:
    """A message that a queue has returned."""

    queue: PolicyQueue
    item: Item
    held: asyncio.Future[None] | None = None  # on a no_drop topic: done when the relay holds it
    pong: Any = None  # on others: done when the relay has it
    left: bool = False  # whether the queue was told that it has left

    def leave(self) -> None:
        """Tell the queue, once."""
        if not self.left:
            self.left = True
            self.queue.gone()


class RobotClient(Session):
    """A session with a queue. See the module's text."""

    def __init__(
        self,
        url: str,
        name: str,
        *,
        topics: Sequence[Topic] = (),
        policy: str | Policy = "robofleet",
        capacity: int = 32,
        window: int | None = None,
        value: Value | None = None,
        robot: str = "",
        token: str | Callable[[], str | None] | None = None,
        tls: ssl.SSLContext | None = None,
        log: Callable[[int, Record], None] | None = None,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """
        Args:
            topics: topics to publish on and their rules; without any, ordinary messages can't be published.
            policy: a drop rule for one topic, a scheduler for several.
            capacity: L, messages of all topics together.
            window: n_T, messages sent and not yet answered by the relay, at most; None: as many as fill the link.
            value: V of topics that have none of their own.
            log: called with the number of the queue, which ``change`` counts, and each record of its events.
            url, name, robot, token, tls, say: as for ``Session``.
        """
        super().__init__(url, name, robot=robot, token=token, tls=tls, say=say)
        self._topics = tuple(topics)
        self._numbers = {topic.name: k for k, topic in enumerate(topics)}
        self._capacity, self._window, self._value, self._log = capacity, window, value, log
        self._queues: deque[PolicyQueue] = deque()
        """Queues by age: messages go into the last; the others return their rest under their own policies."""
        self._changes = 0
        self._away: deque[_Away] = deque()
        self._moved = asyncio.Event()
        self._seqs: Counter[str] = Counter()
        if topics:
            self.change(policy)

    def change(self, policy: str | Policy) -> None:
        """Change the policy from now on; messages already queued go first, under the previous policy."""
        log, number = self._log, self._changes
        own = None if log is None else lambda record: log(number, record)
        settings: dict[str, Any] = {"topics": self._topics, "window": self._window or 1, "value": self._value}
        queue = PolicyQueue(policy, self._capacity, log=own, **settings)
        self._changes += 1
        queue.left_bytes = self._left_bytes
        before = self._queues[-1] if self._queues else None
        self._queues.append(queue)
        if before is not None:
            before.close()

    @property
    def queue(self) -> PolicyQueue:
        """The queue that messages are put into."""
        return self._queues[-1]

    def publish(
        self,
        topic: str,
        payload: bytes,
        encoding: str = "json",
        type: str = "",
        x: float | None = None,
        stamp_us: int | None = None,
    ) -> None:
        """Put a message into the queue, from any thread. Never blocks; the policy decides whether it goes.

        Args:
            topic: one of ``topics``.
            payload: in that ``encoding`` (json, cdr, ros1, jpeg, png, or a name that the receivers know).
            type: as in ROS, ``sensor_msgs/msg/LaserScan``.
            x: coordinate of the scene; None means 1 more than the last.
            stamp_us: us since 1970; None: now.

        Raises RefusedError: it is larger than the relay takes.
        """
        if topic not in self._numbers:
            raise BufgymError(f"topic {topic!r}: this client publishes {', '.join(self._numbers) or 'nothing'}")
        self._seqs[topic] += 1
        stamp_us = time.time_ns() // 1000 if stamp_us is None else stamp_us
        message = wire.Message(topic, payload, encoding, type, "", self._seqs[topic], stamp_us)
        size_bytes = self.check_size(message)
        while True:
            queue = self.queue
            try:
                queue.put(message, size_bytes, x, self._numbers[topic])
                return
            except BufgymError:
                if queue is self.queue:  # else the policy was changed in that moment
                    raise

    async def ping(self) -> None:
        """Measure ``round_trip_s``, unless the connection ends before the answer."""
        with contextlib.suppress(Exception):  # as in ``run``, which notes it
            if self._connection is not None:
                self.round_trip_s = await (await self._connection.ping())

    def _works(self) -> list[Coroutine[Any, Any, None]]:
        return [*super()._works(), self._send_all(), self._leave_all()]

    def _left_bytes(self) -> int | None:
        link = self._connection
        if link is None or (unsent := unsent_bytes(link.transport.get_extra_info("socket"))) is None:
            return None
        return unsent + int(link.transport.get_write_buffer_size())

    async def _send_all(self) -> None:
        """Send what the queues return, in order, after the messages that the last connection left."""
        for away in self._away:
            away.pong = None
        for away in list(self._away):
            await self._send(away)
        while self._queues:
            item = await self._queues[0].aget()
            if item is None:  # the queue is closed: another policy follows
                self._queues.popleft()
                continue
            away = _Away(self._queues[0], item)
            self._away.append(away)
            await self._send(away)
            if away.held is None and self._window is None:
                await until_writable(self._connection.transport.get_extra_info("socket"))
                away.leave()

    async def _send(self, away: _Away) -> None:
        message = away.item.message
        if away.held is None:
            try:
                self.check_size(message)
            except wire.RefusedError as refused:  # it was queued before the relay said how much it takes
                self.note(str(refused))
                self._away.remove(away)
                away.leave()
                return
            if any(pattern.whole(message.topic) for pattern in self._no_drop):
                away.held = self._unanswered.put(message._replace(no_drop=True))
                self._wanted.set()
            else:
                await self._connection.send(wire.encode(message))
                away.pong = await self._connection.ping()
        self._moved.set()

    async def _leave_all(self) -> None:
        """Tell the queues in order which messages have left."""
        while True:
            await self._moved.wait()
            self._moved.clear()
            while self._away and (answer := self._away[0].held or self._away[0].pong) is not None:
                await asyncio.wait([answer])
                if (error := answer.exception()) is not None:
                    if answer is not self._away[0].held:
                        raise error  # the connection has ended
                    self.note(str(error))
                self._away.popleft().leave()
