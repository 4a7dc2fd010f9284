"""Publishes what a relay has received, each topic once its readers are there.

DDS drops what is published before reader and writer have found each other. The receiver acks a message when this has
published it, so the robot would never send such a message again. A receiver that was restarted is a new writer to all
its readers. Latched state waits for none: its writer keeps it for readers that come (``States``).
"""

import asyncio
import functools
import time
from collections.abc import Awaitable, Callable
from typing import Any, Final

from bufgym.utils.errors import BufgymError
from bufgym_robot.receiver import Received
from bufgym_robot.ros2.mismatch import of_publisher
from bufgym_robot.ros2.names import Published, overriding, parse
from bufgym_robot.ros2.states import States

HOLD_S: Final = 10.0
"""Time from the start in which messages wait for readers; by then participants of DDS have found each other."""
_MATCH_S: Final = 2.0  # longest wait of a new publisher for a reader that is known
_SETTLE_S: Final = 0.1  # from the match at the writer to that at the reader, of which nothing tells the writer
_LOOK_S: Final = 0.01


class Republisher:
    """Call it with each received message."""

    def __init__(self, node: Any, hold_s: float, say: Callable[[str], None]) -> None:
        self._node, self._say = node, say
        self._hold_until_s = time.monotonic() + hold_s
        self._publishers: dict[Published, Any] = {}
        self._found: dict[Published, asyncio.Task[None]] = {}
        self._states: dict[str, States] = {}

    def __call__(self, message: Received) -> Awaitable[None] | None:
        """Publish it, now or once its topic's readers are there."""
        topic, body = parse(message.body)
        if message.source is not None:
            states = self._states.setdefault(topic.name, States(self._made, self._node.destroy_publisher))
            states.take(topic, message.stream, message.source, body)
            return None
        publisher = self._publisher(topic)
        if publisher is None:
            return None
        if not self._found[topic].done():
            return self._publish_later(publisher, body, self._found[topic])
        publisher.publish(body)
        return None

    def expect(self, body: bytes | memoryview) -> None:
        """Make ready for a message that comes after those that wait: its topic's readers are found meanwhile."""
        self._publisher(parse(body)[0])

    def _publisher(self, topic: Published) -> Any:
        if topic not in self._publishers:
            self._publishers[topic] = publisher = self._made(topic)
            if publisher is not None:
                name = publisher.topic_name
                known = functools.partial(_readers, self._node, name, topic.qos)
                finding = readers_found(name, publisher.get_subscription_count, known, self._hold_until_s, self._say)
                self._found[topic] = asyncio.create_task(finding)
        return self._publishers[topic]

    async def _publish_later(self, publisher: Any, body: bytes, found: asyncio.Task[None]) -> None:
        # Publishing comes last: a connection that ends while this waits leaves the message to the next one.
        await asyncio.shield(found)
        publisher.publish(body)

    def drain(self) -> None:
        """Wait until readers have acked what was published; the end of a writer takes the rest with it."""
        until_s = time.monotonic() + _MATCH_S
        for publisher in (*self._publishers.values(), *(states.writer for states in self._states.values())):
            while publisher is not None and not _all_acked(publisher) and time.monotonic() < until_s:
                time.sleep(_LOOK_S)

    def _made(self, topic: Published) -> Any:
        try:
            options = {"qos_overriding_options": overriding(), "event_callbacks": of_publisher(topic.name, self._say)}
            kind = topic.serialized_class
            publisher = self._node.create_publisher(kind, topic.name, topic.qos, **options)
        except BufgymError as error:
            self._say(f"{topic.name}: dropped: {error}")
            return None
        self._say(f"{topic.name}: {topic.type}" + (f", latched by {topic.depth}" if topic.latched else ""))
        return publisher


def _readers(node: Any, name: str, qos: Any) -> int:
    """Count the readers that can match a publisher of this quality of service; others would be waited for in vain."""
    from rclpy.qos import QoSCompatibility, qos_check_compatible

    asked = [one.qos_profile for one in node.get_subscriptions_info_by_topic(name)]
    return sum(qos_check_compatible(qos, one)[0] != QoSCompatibility.ERROR for one in asked)


async def readers_found(
    name: str, matched: Callable[[], int], known: Callable[[], int], hold_until_s: float, say: Callable[[str], None]
) -> None:
    """Wait for all readers that a new publisher's node knows of; until ``hold_until_s`` for one at least."""

    def found() -> bool:
        return matched() >= max(1, known())

    if matched() == 0 and time.monotonic() < hold_until_s:
        say(f"{name}: messages wait for a reader, {hold_until_s - time.monotonic():.0f} s at most")
    until_s = max(hold_until_s, time.monotonic() + (_MATCH_S if known() else 0.0))
    while not found() and time.monotonic() < until_s:
        await asyncio.sleep(_LOOK_S)
    if found():
        await asyncio.sleep(_SETTLE_S)


def _all_acked(publisher: Any) -> bool:
    from rclpy.duration import Duration

    return bool(publisher.wait_for_all_acked(Duration(nanoseconds=1_000_000)))
