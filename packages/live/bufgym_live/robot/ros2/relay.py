"""Relay that subscribes on the robot, sends over one uplink, and republishes at the other end.

    robot's nodes -> subscription (serialized) -> PolicyQueue -> Sender ==uplink==> Receiver -> publisher -> nodes

Each end is one asyncio program; the robot's subscriptions run in a thread of rclpy's executor. Commands go the other
way through a second pair with ``no_drop`` topics.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from functools import partial
from typing import Any, Final

from bufgym.ground.errors import BufgymError
from bufgym.policies.registry import Policy
from bufgym.scenario import Client
from bufgym_live.robot import LogFile, PolicyQueue
from bufgym_live.robot.channels import TRANSPORTS
from bufgym_live.robot.log import Record
from bufgym_live.robot.odometry import Odometry, followed
from bufgym_live.robot.receiver import Received, Receiver
from bufgym_live.robot.ros2.names import Published, needs_rclpy, parse, published
from bufgym_live.robot.sender import Leaves, Sender
from bufgym_live.robot.tasks import until_one_ends

SENDER, RECEIVER = "bufgym_send", "bufgym_receive"
"""Names of the nodes. A sender ignores topics of a receiver, so a pair each way makes no loop."""
LOOK_S: Final = 0.2  # Time between two searches for publishers
_MATCH_S: Final = 1.0  # longest wait of a new publisher's first message for a subscriber


def resolved(name: str) -> str:
    return name if name.startswith("/") else f"/{name}"


@contextmanager
def own_node(name: str) -> Iterator[Any]:
    """A node of its own context."""
    with needs_rclpy():
        import rclpy
        from rclpy.signals import SignalHandlerOptions
    context = rclpy.Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(name, context=context, enable_rosout=False, start_parameter_services=False)
    try:
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
    node: Any, names: Sequence[str], found: Callable[[Published], list[Any]], but_not: str, say: Callable[[str], None]
) -> None:
    """Call ``found`` for each of these topics that has a publisher not named ``but_not``; never return.

    ``found`` returns its subscriptions. Where publishers come back with another type or quality of service, these are
    destroyed and it is called again. A topic whose messages are not installed here is left out, and told once.
    """
    known: dict[str, Published] = {}
    made: dict[str, list[Any]] = {}
    while True:
        for name in names:
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
    """The sending end, which sends the topics of ``client`` over one uplink to ``host`` and ``port``."""

    def __init__(
        self,
        client: Client,
        host: str,
        port: int,
        *,
        policy: str | Policy = "learned-scheduler",
        capacity: int = 32,
        odometry: str | None = None,
        transport: str = "tcp",
        window: int | None = None,
        log: LogFile | Callable[[Record], None] | None = None,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """
        Args:
            client: topics with their rules; ``bufgym.scenario.read_client`` reads one.
            policy: a drop rule for one topic, a scheduler for several.
            capacity: L, messages of all topics together.
            odometry: a topic with poses, which gives x to topics that move; x of other topics is time. The poses of one
                frame count (TOPIC:FRAME, of tf TOPIC:PARENT:CHILD, else that of the first).
            window: n_T, messages sent and not yet acked by the receiver, at most; None: as many as fill the link.
            say: called with a line for each topic found.
        """
        moving = [stream.topic.name for stream in client.streams if stream.moves]
        if moving and odometry is None:
            raise BufgymError(f"topic {moving[0]!r}: moves, which needs a topic with odometry")
        self.queue = PolicyQueue(
            policy, capacity, value=client.value, topics=client.topics, window=window or 1, log=log
        )
        leaves: Leaves = "sent" if window is None else "acked"
        self.sender = Sender(self.queue, lambda: TRANSPORTS[transport](host, port), leaves)
        self._streams = client.streams
        self._numbers = {resolved(stream.topic.name): number for number, stream in enumerate(client.streams)}
        topic, self._odometry = ("", Odometry()) if odometry is None else followed(odometry)
        self._odometry_topic = resolved(topic) if topic else None
        self._began_s = time.monotonic()
        self._say = say

    async def run(self) -> None:
        """Relay until cancelled."""
        with own_node(SENDER) as node:
            names = [*self._numbers, *([] if self._odometry_topic is None else [self._odometry_topic])]
            async with spinning(node):
                found = partial(self._subscribe, node)
                await until_one_ends(self.sender.run(), look(node, names, found, RECEIVER, self._say))

    def _subscribe(self, node: Any, topic: Published) -> list[Any]:
        subscribe = partial(node.create_subscription, topic.message_class, topic.name)
        made = []
        self._say(f"{topic.name}: {topic.type}, {'reliable' if topic.reliable else 'best effort'}")
        number = self._numbers.get(topic.name)
        if number is not None:
            stream, head = self._streams[number], topic.head()

            def put(message: bytes) -> None:
                x = self._odometry.x if stream.moves else (time.monotonic() - self._began_s) * stream.unit_hz
                self.queue.put(head + message, len(head) + len(message), x, number)

            made.append(subscribe(put, topic.qos, raw=True))
        if topic.name == self._odometry_topic:
            made.append(subscribe(self._odometry.take, topic.qos))
        return made


async def receive(
    port: int, host: str = "127.0.0.1", transport: str = "tcp", say: Callable[[str], None] = lambda text: None
) -> None:
    """Run the other end: republish messages with their publishers' quality of service, until cancelled.

    Messages of a type that is not installed here are reported once and dropped.
    """
    with own_node(RECEIVER) as node:
        publishers: dict[Published, Any] = {}

        async def republish(message: Received) -> None:
            topic, body = parse(message.body)
            if topic not in publishers:
                try:
                    publishers[topic] = node.create_publisher(topic.message_class, topic.name, topic.qos)
                    say(f"{topic.name}: {topic.type}")
                except BufgymError as error:
                    publishers[topic] = None
                    say(f"{topic.name}: dropped: {error}")
                else:
                    await matched(publishers[topic].get_subscription_count)
            if publishers[topic] is not None:
                publishers[topic].publish(body)

        receiver = Receiver(republish)
        say(f"listening on {host}:{await receiver.listen(port, host, transport)}")
        try:
            await asyncio.Event().wait()
        finally:
            await receiver.close()


async def matched(subscribers: Callable[[], int]) -> None:
    """Wait for subscribers to find a new publisher, which takes some 100 ms; earlier messages would be missed."""
    deadline_s = time.monotonic() + _MATCH_S
    while subscribers() == 0 and time.monotonic() < deadline_s:
        await asyncio.sleep(0.01)
