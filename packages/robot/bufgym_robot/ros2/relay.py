"""Relay that subscribes on the robot, sends over one uplink, and republishes at the other end.

    robot's nodes -> subscription (serialized) -> PolicyQueue -> Sender ==uplink==> Receiver -> publisher -> nodes
                     latched topics            -> Latched ----->

Each end is one asyncio program, which DDS wakes for each message (``taking.Hearing``). A thread of rclpy's executor
does the rest. Messages of latched topics are taken from time to time, with their publishers. Commands go the
other way through a second pair with ``no_drop`` topics.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Iterable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager, nullcontext, suppress
from dataclasses import replace
from functools import partial
from typing import Any, Final

from bufgym.model import qoi
from bufgym.model.qoi import Value
from bufgym.policies.registry import Policy
from bufgym.scenario import Client
from bufgym.utils.errors import BufgymError
from bufgym_robot import LogFile, PolicyQueue
from bufgym_robot.channels import TRANSPORTS
from bufgym_robot.frames import MAX_BODY_BYTES
from bufgym_robot.latched import Latched
from bufgym_robot.receiver import Receiver
from bufgym_robot.ros2.diagnostics import Diagnostics, publisher
from bufgym_robot.ros2.mismatch import of_subscription
from bufgym_robot.ros2.names import Published, circle, needs_rclpy, overriding, published, publishers, resolved
from bufgym_robot.ros2.places import left_out, places
from bufgym_robot.ros2.republishing import HOLD_S, Republisher
from bufgym_robot.ros2.taking import Hearing, call_events, source_of, take_all, untaken
from bufgym_robot.sender import Leaves, Sender
from bufgym_robot.wire.log import Record
from bufgym_robot.wire.odometry import Odometry, followed
from bufgym_robot.wire.sockets import BACKOFF_S, host_port
from bufgym_robot.wire.tasks import until_one_ends

SENDER, RECEIVER = "bufgym_send", "bufgym_receive"
"""Names of the nodes. A sender sends no topic that a receiver publishes, so a pair each way makes no circle."""
LOOK_S: Final = 0.2  # Time between two searches for publishers
TELL_S: Final = 1.0  # Time between two messages on /diagnostics
LATCHED_DEPTH: Final = 1000  # Messages of a latched topic that wait to be taken: more than it has publishers


@contextmanager
def own_node(name: str, ros_args: Sequence[str] = ()) -> Iterator[Any]:
    """A node of its own context, with arguments as they come after ``--ros-args``.

    Raises:
        BufgymError: ROS 2 does not know such arguments, or a receiver's name lacks ``bufgym_receive``.
    """
    with needs_rclpy():
        import rclpy
        from rclpy.signals import SignalHandlerOptions
    context = rclpy.Context()
    words = ["--ros-args", *ros_args] if ros_args else []
    try:
        rclpy.init(args=words, context=context, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy's own, of several kinds
        raise BufgymError(f"--ros-args {' '.join(ros_args)}: {str(error).partition(', at ')[0]}") from None
    node = rclpy.create_node(name, context=context, enable_rosout=False)
    try:
        if name == RECEIVER and RECEIVER not in node.get_name():
            raise BufgymError(f"node {node.get_name()!r}: must have {RECEIVER} in its name, or senders make a circle")
        yield node
    finally:
        node.destroy_node()
        rclpy.try_shutdown(context=context)


@asynccontextmanager
async def spinning(node: Any) -> AsyncIterator[None]:
    """Call the node's callbacks in a thread, as long as the block takes."""
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)

    def spin() -> None:
        with suppress(ExternalShutdownException):
            executor.spin()

    thread = asyncio.create_task(asyncio.to_thread(spin))
    try:
        yield
    finally:
        executor.shutdown(timeout_sec=2.0)
        await asyncio.gather(thread, return_exceptions=True)


async def look(
    node: Any,
    names: Callable[[], Iterable[str]],
    found: Callable[[Published], list[Any]],
    but_not: str,
    say: Callable[[str], None],
) -> None:
    """Call ``found`` for each of these topics that has a publisher without ``but_not`` in its name; never return.

    ``found`` returns its subscriptions. Where publishers come back with another type or quality of service, these are
    destroyed and it is called again. A topic that can't be subscribed to is left out, and told once.
    """
    known: dict[str, Published] = {}
    made: dict[str, list[Any]] = {}
    while True:
        for name in names():
            topic = published(node, name, but_not)
            if topic is None or topic == known.get(name):
                continue
            known[name] = topic
            for subscription in made.pop(name, []):
                node.destroy_subscription(subscription)
            try:
                made[name] = found(topic)
            except BufgymError as error:
                say(f"{name}: left out: {error}")
        await asyncio.sleep(LOOK_S)


class RosSender:
    """The sending end, which sends topics over one uplink to ``host`` and ``port``."""

    def __init__(
        self,
        client: Client | None,
        host: str,
        port: int,
        *,
        topics: Sequence[str] = (),
        policy: str | Policy | None = None,
        capacity: int = 32,
        value: Value | None = None,
        odometry: str | None = None,
        transport: str = "tcp",
        window: int | None = None,
        backoff_s: float = BACKOFF_S,
        log: LogFile | Callable[[Record], None] | None = None,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """
        Args:
            client: topics with their rules; ``bufgym.scenario.read_client`` reads one.
            topics: more topics, without rules; their x is the motion with ``odometry``, otherwise it counts messages.
                A name with ``*`` or ``?``, here or in ``client``, is a pattern, and stands for up to 64 topics.
            policy: a drop rule for one topic, a scheduler for several; None: afr or gap-priority.
            capacity: L, messages of all topics together, and the least depth of each subscription.
            value: V of topics without one; None: the client's, or 1 - 0.618^d.
            odometry: a topic with poses, which gives x to topics that move; x of other topics is time. The poses of one
                frame count (TOPIC:FRAME, of tf TOPIC:PARENT:CHILD, else that of the first).
            window: n_T, messages sent and not yet acked by the receiver, at most; None: as many as fill the link.
            backoff_s: longest time between two tries of TCP at a dead link.
            say: called with a line for each topic found or left out, and for each reason why there is no connection.
        """
        self._places = places(client, topics, odometry is not None)
        value = value or (qoi.exponential() if client is None else client.value)
        rules = [place.topic for place in self._places]
        self._diagnostics = Diagnostics([topic.value or value for topic in rules])

        def record(one: Record) -> None:
            self._diagnostics(one)
            if log is not None:
                log(one)

        self.queue = PolicyQueue(
            policy or ("afr" if len(rules) == 1 else "gap-priority"),
            capacity,
            value=value,
            topics=rules,
            window=window or 1,
            log=record,
        )
        self.latched = Latched()
        self._taken: dict[str, tuple[Published, int, Any]] = {}  # latched topics, their numbers and subscriptions
        self._hearing: dict[str, Hearing] = {}  # other topics
        leaves: Leaves = "sent" if window is None else "acked"
        self._fault = "no answer yet"
        self._to = host_port(host, port)
        connect = partial(TRANSPORTS[transport], host, port, backoff_s=backoff_s)
        self.sender = Sender(self.queue, connect, leaves, self._on_connection, self.latched)
        self._depth = capacity
        self._left_out: set[str] = set()
        self._circles: set[str] = set()
        self._too_large: set[str] = set()
        self._odometry_topic: str | None
        self._odometry_topic, self._odometry = (None, Odometry()) if odometry is None else followed(odometry)
        self._say = say

    async def run(self, node: Any = None) -> None:
        """Relay until cancelled, with a node of its own unless one is given."""
        with own_node(SENDER) if node is None else nullcontext(node) as node:
            self._odometry_topic = self._odometry_topic and resolved(node, self._odometry_topic)
            for place in self._places:
                place.resolve(node)
            async with spinning(node):
                looking = look(node, partial(self._names, node), partial(self._subscribe, node), RECEIVER, self._say)
                try:
                    beside = self._take_latched(node), self._call_events(), self._tell(node)
                    await until_one_ends(self.sender.run(), looking, *beside)
                finally:
                    while self._hearing:
                        self._hearing.popitem()[1].end()

    def _on_connection(self, fault: str) -> None:
        self._fault = fault
        self._say(f"not connected to {self._to}: {fault}" if fault else f"connected to {self._to}")

    async def _tell(self, node: Any) -> None:
        """Publish each topic's numbers and how the connection is, also while there is no topic."""
        publish = publisher(node, self._say)
        while True:
            await asyncio.sleep(TELL_S)
            told = zip(self._places, self._diagnostics.tell(), strict=True)
            numbers = {place.name: values for place, values in told if place.name is not None}
            for topic, number, _ in self._taken.values():
                latched, owed = self.latched.count(number)
                numbers[topic.name] = {"latched": latched, "owed": owed}
            publish(numbers, f"not connected to {self._to}: {self._fault}" if self._fault else "")

    def _names(self, node: Any) -> list[str]:
        """Names of the topics to look for; topics that a pattern fits take one of its places."""
        if any(place.by_pattern for place in self._places):
            names = [name for name, _ in node.get_topic_names_and_types() if node.count_publishers(name)]
            for place in self._places:
                place.find(names, [one.name for one in self._places])
            for name, why in left_out(self._places, names).items():
                if name not in self._left_out:
                    self._left_out.add(name)
                    self._say(f"{name}: left out: {why}")
        names = [place.name for place in self._places if place.name is not None]
        self._look_for_circles(node, names)
        return names if self._odometry_topic is None else [*names, self._odometry_topic]

    def _look_for_circles(self, node: Any, names: Sequence[str]) -> None:
        """Leave topics out while their copies would be sent again."""
        for name in names:
            why = circle(node, name, RECEIVER)
            if why and name not in self._circles:
                self._circles.add(name)
                self._say(f"{name}: left out: {why}")
            elif not why and name in self._circles:
                self._circles.remove(name)
                self._say(f"{name}: no longer left out")

    def _fits(self, name: str, head: bytes, message: bytes) -> bool:
        """Whether a receiver takes such a message with its topic's head; says so once for each topic if not."""
        if name in self._circles:
            return False
        most_bytes = MAX_BODY_BYTES - len(head)
        if len(message) > most_bytes and name not in self._too_large:
            self._too_large.add(name)
            self._say(f"{name}: dropped: messages over {most_bytes} bytes, as one of {len(message)}")
        return len(message) <= most_bytes

    async def _call_events(self) -> None:
        """Call subscriptions' events from time to time, in place of the executor."""
        while True:
            for subscription in [one.subscription for one in self._hearing.values()]:
                call_events(subscription)
            for _, _, subscription in self._taken.values():
                call_events(subscription)
            await asyncio.sleep(LOOK_S)

    async def _take_latched(self, node: Any) -> None:
        """Take latched topics' messages from time to time; they are no stream."""
        while True:
            for topic, number, subscription in self._taken.values():
                head = topic.head()
                for message, source, stamp_ns in take_all(subscription):
                    known = self.latched.sources(number)
                    if source not in known and len(known) >= topic.depth:
                        self.latched.keep(number, {source_of(gid) for gid in publishers(node, topic.name, RECEIVER)})
                    if self._fits(topic.name, head, message):
                        self.latched.put(number, source, head + message, stamp_ns // 1000)
            await asyncio.sleep(LOOK_S)

    def _subscribe(self, node: Any, topic: Published) -> list[Any]:
        made = []
        self._taken.pop(topic.name, None)
        if topic.name in self._hearing:
            self._hearing.pop(topic.name).end()
        what = ", latched" if topic.latched else ""
        self._say(f"{topic.name}: {topic.type}, {'reliable' if topic.reliable else 'best effort'}{what}")
        number = next((k for k, place in enumerate(self._places) if place.name == topic.name), None)
        if number is not None:
            place, head = self._places[number], topic.head()

            def put(message: bytes) -> None:
                moved = None if self._odometry_topic is None else self._odometry.x
                if self._fits(topic.name, head, message):
                    self.queue.put(head + message, len(head) + len(message), place.x(node, moved), number)

            deep = replace(topic, depth=max(LATCHED_DEPTH if topic.latched else self._depth, topic.depth)).qos
            options = {
                "qos_overriding_options": overriding(),
                "event_callbacks": of_subscription(topic.name, self._say),
                "callback_group": untaken() if topic.latched or Hearing.possible() else None,
            }
            kind = topic.serialized_class
            made.append(node.create_subscription(kind, topic.name, put, deep, raw=True, **options))
            if topic.latched:
                self._taken[topic.name] = topic, number, made[0]
            elif Hearing.possible():
                self._hearing[topic.name] = Hearing(made[0], put)
        if topic.name == self._odometry_topic:
            made.append(node.create_subscription(topic.message_class, topic.name, self._odometry.take, topic.qos))
        return made


async def receive(
    port: int,
    host: str = "127.0.0.1",
    transport: str = "tcp",
    say: Callable[[str], None] = lambda text: None,
    ros_args: Sequence[str] = (),
    hold_s: float = HOLD_S,
) -> None:
    """Run the other end: republish messages with their publishers' quality of service, until cancelled.

    Messages whose package is not installed here are republished as they came. What ROS 2 can't publish is reported once
    and dropped. For ``hold_s`` from its start a topic's messages wait for readers (``Republisher``).
    """
    with own_node(RECEIVER, ros_args) as node:
        republisher = Republisher(node, hold_s, say)
        receiver = Receiver(republisher, expect=republisher.expect)
        say(f"listening on {host_port(host, await receiver.listen(port, host, transport))}")
        try:
            async with spinning(node):
                await asyncio.Event().wait()
        finally:
            await receiver.close()
            republisher.drain()
