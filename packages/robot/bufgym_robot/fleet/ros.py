"""A robot's own ROS as a source: topics of ROS 1 or ROS 2 go to the relay, and messages come back from it.

A message that others publish on ``/robots/NAME/to/TOPIC``, in CDR and with its type, is published on ``/TOPIC`` here if
the robot was told to receive that topic.
"""

import asyncio
import functools
import struct
import time
from collections import defaultdict
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from typing import Any, Final

from bufgym.scenario import Stream
from bufgym.utils.errors import BufgymError
from bufgym_robot.fleet.robot import Robot
from bufgym_robot.ros1 import needs_rospy
from bufgym_robot.ros2.names import Published
from bufgym_robot.ros2.relay import look, own_node, spinning
from bufgym_robot.ros2.republishing import HOLD_S, readers_found
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire import ros_messages
from bufgym_robot.wire.patterns import escaped
from bufgym_robot.wire.tasks import until_one_ends

NODE: Final = "bufgym_robot"
TWIST: Final = Published("/cmd_vel", "geometry_msgs/msg/Twist")
"""Topic on which a person drives the robot, if it is one of those that it receives."""
Outlet = Callable[[bytes], Callable[[], None]]
"""Reads a message in CDR, and returns what publishes it here, or raises a BufgymError if nobody would hear it."""


def resolved(name: str) -> str:
    return name if name.startswith("/") else f"/{name}"


def _to_readers(name: str, readers: Callable[[], int], publish: Callable[[], None]) -> None:
    """Publish; ROS drops without a word what nobody subscribes to, and that would be no execution."""
    if not readers():
        raise BufgymError(f"nobody here subscribes to {name}")
    publish()


class _RosSource:
    """Code shared by both versions of ROS."""

    def __init__(self, streams: Sequence[Stream], receive: Sequence[str] = ()) -> None:
        """``receive`` lists topics to publish here."""
        self.streams = tuple(streams)
        self._names = {resolved(stream.topic.name): stream.topic.name for stream in streams}
        self._receive = tuple(map(resolved, receive))
        self._outlets: dict[Published, Outlet] = {}
        self._advertise: Callable[[Published], Awaitable[Outlet]] | None = None
        self._advertising: defaultdict[Published, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._is_stopped: Callable[[], bool] = lambda: False

    def _wanted(self, robot: Robot) -> list[str]:
        """Its topics, and the one that is named as the robot's odometry, which need not be one of them."""
        odometry = robot.place.topic
        return sorted({*self._names, *([resolved(odometry)] if odometry else [])})

    def _take(self, robot: Robot, name: str, payload: bytes, encoding: str, type: str) -> None:
        """Publish a message of this ROS at the relay, from any thread."""
        if name in self._names:
            robot.publish(self._names[name], payload, encoding, type)
        else:
            robot.place.take(name, payload, type, encoding)

    def _listen(self, robot: Robot, advertise: Callable[[Published], Awaitable[Outlet]]) -> None:
        """Publish messages for the topics that this robot receives; note messages that fail."""
        before = robot.topic("to")
        self._advertise, self._is_stopped = advertise, lambda: robot.latch.is_set

        async def take(message: wire.Message) -> str:
            return await robot.once(message, functools.partial(publish_it, message))

        async def publish_it(message: wire.Message) -> str:
            name = message.topic.removeprefix(before)
            if name not in self._receive or message.encoding != "cdr":
                return f"this robot takes {', '.join(self._receive)} in CDR"
            try:
                outlet = await self._outlet(Published(name, message.type))
                publish = outlet(bytes(message.payload))
                # Only now: while ROS matched a new publisher, the deadline may have passed, or a stop have come. The
                # first message of a type takes long to read, too.
                if why := robot.refusal(message):
                    raise BufgymError(why)
                publish()
            except Exception as error:  # messages are untrusted, and ROS has its own error types
                robot.client.note(f"{message.topic}: not published: {error}")
                return f"not published: {error}"
            return ""

        if self._receive:
            robot.client.subscribe(f"^{escaped(before)}/", take)

    async def _outlet(self, topic: Published) -> Outlet:
        """Publisher of a topic here, which is made when it is first asked for."""
        async with self._advertising[topic]:  # a stop does not wait for another topic's readers
            if topic not in self._outlets:
                if self._advertise is None:
                    raise BufgymError(f"topic {topic.name}: not published: ROS is not there yet")
                self._outlets[topic] = await self._advertise(topic)
        return self._outlets[topic]

    async def _expect_stops(self) -> None:
        """Find the readers of velocities before the first stop, which would wait for them; never return.

        If a stop holds by then, say zeros: it may move at what this program said before it was killed, and a stop
        that came before ROS was there has reached nobody.
        """
        if TWIST.name in self._receive:
            with suppress(BufgymError):  # the next stop says it
                await self._outlet(TWIST)
                if self._is_stopped():
                    await self.on_command({"command": "stop"})
        await asyncio.Event().wait()

    def status(self) -> dict[str, Any]:
        """Return the topics that others may publish on, below ``to``, and whether one of them drives it."""
        return {"receives": self._receive, "commands": ["drive"] if TWIST.name in self._receive else []}

    async def on_command(self, command: Any) -> None:
        """Publish a velocity as a Twist, zeros at a stop; refuse other commands, because ROS takes them on topics."""
        match command:
            case {"command": "stop"} if TWIST.name in self._receive:
                (await self._outlet(TWIST))(b"\0\1\0\0" + bytes(48))()
                return
            case {"command": "drive", "linear": linear, "angular": angular} if TWIST.name in self._receive:
                publish = (await self._outlet(TWIST))(b"\0\1\0\0" + struct.pack("<6d", linear, 0, 0, 0, 0, angular))
                if (linear, angular) == (0, 0) or not self._is_stopped():  # a stop may have come meanwhile
                    publish()
                return
        raise BufgymError(f"command {command!r}: this robot takes commands on topics of ROS: {self._receive}")


class Ros2(_RosSource):
    """Topics of ROS 2 (rclpy)."""

    async def run(self, robot: Robot) -> None:
        with own_node(NODE) as here:
            from rclpy.serialization import deserialize_message

            until_s = time.monotonic() + HOLD_S

            async def advertise(topic: Published) -> Outlet:
                publisher = here.create_publisher(topic.message_class, topic.name, topic.qos)
                known = functools.partial(here.count_subscribers, topic.name)
                await readers_found(topic.name, publisher.get_subscription_count, known, until_s, robot.client.note)

                def read(payload: bytes) -> Callable[[], None]:
                    deserialize_message(payload, topic.message_class)  # nodes would meet what is broken
                    publish = functools.partial(publisher.publish, payload)
                    return functools.partial(_to_readers, topic.name, publisher.get_subscription_count, publish)

                return read

            def subscribe(topic: Published) -> list[Any]:
                def take(payload: bytes) -> None:
                    self._take(robot, topic.name, payload, "cdr", topic.type)

                return [here.create_subscription(topic.message_class, topic.name, take, topic.qos, raw=True)]

            self._listen(robot, advertise)
            async with spinning(here):
                looking = look(here, lambda: self._wanted(robot), subscribe, NODE, robot.client.note)
                await until_one_ends(looking, self._expect_stops())


class Ros1(_RosSource):
    """Topics of ROS 1 (rospy)."""

    async def run(self, robot: Robot) -> None:
        with needs_rospy():
            import rospy
        await asyncio.to_thread(ros_messages.load)  # for a second or two; a command would be late
        rospy.init_node(NODE, anonymous=True, disable_signals=True)
        until_s = time.monotonic() + HOLD_S

        async def advertise(topic: Published) -> Outlet:
            publisher = rospy.Publisher(topic.name, topic.message_class, queue_size=10)
            # Only the master knows of readers; one is waited for a moment, also later than at the start.
            await readers_found(topic.name, publisher.get_num_connections, lambda: 1, until_s, robot.client.note)

            def read(payload: bytes) -> Callable[[], None]:
                sent = rospy.AnyMsg()
                sent._buff = ros_messages.as_ros1(payload, topic.type)
                publish = functools.partial(publisher.publish, sent)
                return functools.partial(_to_readers, topic.name, publisher.get_num_connections, publish)

            return read

        self._listen(robot, advertise)
        subscribers = [rospy.Subscriber(name, rospy.AnyMsg, self._taker(robot, name)) for name in self._wanted(robot)]
        try:
            await self._expect_stops()
        finally:
            for subscriber in subscribers:
                subscriber.unregister()
            rospy.signal_shutdown("the robot ends")

    def _taker(self, robot: Robot, name: str) -> Callable[[Any], None]:
        def take(message: Any) -> None:
            package, _, kind = message._connection_header["type"].partition("/")
            type = f"{package}/msg/{kind}"
            encoding, payload = ros_messages.modern(message._buff, type, "ros1")
            self._take(robot, name, payload, encoding, type)

        return take


SOURCES: Final = {"1": Ros1, "2": Ros2}  # Version of ROS -> its source
