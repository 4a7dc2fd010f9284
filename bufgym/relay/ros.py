"""A robot's own ROS as a source: topics of ROS 1 or ROS 2 go to the relay, and what the relay sends comes back.

What others publish on ``/robots/NAME/to/TOPIC``, in CDR and with its type, is published on ``/TOPIC`` here, if that is
one of the topics that the robot was told to receive.
"""

from __future__ import annotations

import asyncio
import importlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, Final

from bufgym.errors import BufgymError
from bufgym.relay import ros_messages, wire
from bufgym.relay.robot import Robot
from bufgym.ros2.names import Published, published
from bufgym.ros2.relay import LOOK_S, own_node, resolved
from bufgym.scenario import Stream

NODE: Final = "bufgym_robot"


class _Ros:
    """What both versions share."""

    def __init__(self, streams: Sequence[Stream], odometry: str | None = None, receive: Sequence[str] = ()) -> None:
        """``odometry``: poses, which need not be among the streams; ``receive``: topics that may be published here."""
        self.streams = tuple(streams)
        self._names = {resolved(stream.topic.name): stream.topic.name for stream in streams}
        self._odometry = None if odometry is None else resolved(odometry)
        self._receive = tuple(map(resolved, receive))

    @property
    def _wanted(self) -> set[str]:
        return {*self._names, *([] if self._odometry is None else [self._odometry])}

    def _take(self, robot: Robot, name: str, payload: bytes, encoding: str, type: str) -> None:
        """A message of this ROS, in any thread."""
        if name in self._names:
            robot.publish(self._names[name], payload, encoding, type)
        elif type in ros_messages.POSES:
            robot.locate(payload, type, encoding)

    def _listen(self, robot: Robot, publish: Callable[[str, wire.Message], None]) -> None:
        """Hand on what comes for the topics that this robot receives."""
        before = robot.topic("to")

        def take(message: wire.Message) -> None:
            name = message.topic.removeprefix(before)
            if name in self._receive and message.encoding == "cdr":
                publish(name, message)

        if self._receive:
            robot.client.subscribe(f"^{before}/", take)

    def status(self) -> dict[str, Any]:
        """ROS has no one place for a battery."""
        return {}

    async def on_command(self, command: Any) -> None:
        """Commands of ROS come on topics."""


class Ros2(_Ros):
    """Topics of ROS 2 (rclpy)."""

    async def run(self, robot: Robot) -> None:
        with own_node(NODE) as here:
            from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor

            executor = SingleThreadedExecutor(context=here.context)
            executor.add_node(here)
            publishers: dict[str, Any] = {}

            def publish(name: str, message: wire.Message) -> None:
                if name not in publishers:
                    topic = Published(name, message.type)
                    publishers[name] = here.create_publisher(topic.message_class, name, topic.qos)
                publishers[name].publish(bytes(message.payload))

            def spin() -> None:
                with suppress(ExternalShutdownException):
                    executor.spin()

            self._listen(robot, publish)
            spinning = asyncio.create_task(asyncio.to_thread(spin))
            try:
                await self._look(here, robot)
            finally:
                executor.shutdown(timeout_sec=2.0)
                await asyncio.gather(spinning, return_exceptions=True)

    async def _look(self, here: Any, robot: Robot) -> None:
        """Subscribe to each topic once somebody publishes it."""
        wanted = self._wanted
        while wanted:
            for name in list(wanted):
                topic = published(here, name, NODE)
                if topic is not None:
                    wanted.discard(name)
                    self._subscribe(here, robot, topic)
            await asyncio.sleep(LOOK_S)
        await asyncio.Event().wait()

    def _subscribe(self, here: Any, robot: Robot, topic: Published) -> None:
        def take(payload: bytes) -> None:
            self._take(robot, topic.name, payload, "cdr", topic.type)

        here.create_subscription(topic.message_class, topic.name, take, topic.qos, raw=True)


@contextmanager
def _needs_rospy() -> Iterator[None]:
    try:
        yield
    except ModuleNotFoundError as error:
        raise BufgymError(f"bufgym.relay needs {error.name}: source ROS 1's set-up (python3-rospy)") from None


class Ros1(_Ros):
    """Topics of ROS 1 (rospy)."""

    async def run(self, robot: Robot) -> None:
        with _needs_rospy():
            import rospy
        rospy.init_node(NODE, anonymous=True, disable_signals=True)
        publishers: dict[str, Any] = {}

        def publish(name: str, message: wire.Message) -> None:
            package, _, kind = message.type.partition("/msg/")
            if name not in publishers:
                made = getattr(importlib.import_module(f"{package}.msg"), kind)
                publishers[name] = rospy.Publisher(name, made, queue_size=10)
            sent = rospy.AnyMsg()
            sent._buff = ros_messages.as_ros1(bytes(message.payload), message.type)
            publishers[name].publish(sent)

        self._listen(robot, publish)
        subscribers = [rospy.Subscriber(name, rospy.AnyMsg, self._taker(robot, name)) for name in self._wanted]
        try:
            await asyncio.Event().wait()
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


SOURCES: Final = {"1": Ros1, "2": Ros2}
"""By the version of ROS."""
