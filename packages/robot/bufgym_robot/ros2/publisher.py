"""Publisher for your own ROS 2 node, with a queue ruled by a policy and an uplink of its own.

    camera = bufgym_robot.ros2.Publisher(node, Image, "/camera", policy="afr", queue_size=15, to=("base", 7410))
    camera.publish(image)  # never blocks

``bufgym ros2 receive`` republishes at the other end. Sending one message at a time by DDS would not do: it resends a
message of many packets again and again on a lossy link. Over a fade 38 of 600 frames arrived that way.
"""

import asyncio
import threading
from collections.abc import Callable
from typing import Any

from bufgym.model.qoi import Value
from bufgym.policies.registry import Policy
from bufgym_robot import LogFile, PolicyQueue
from bufgym_robot.channels import TRANSPORTS
from bufgym_robot.ros2.names import DEPTH, Published, needs_rclpy
from bufgym_robot.sender import Sender


class Publisher:
    """Publisher with a policy's queue. See the module's text."""

    def __init__(
        self,
        node: Any,
        msg_type: Any,
        topic: str,
        *,
        to: tuple[str, int],
        policy: str | Policy = "afr",
        queue_size: int = 10,
        reliable: bool = True,
        depth: int = DEPTH,
        value: Value | None = None,
        x: Callable[[], float | None] = lambda: None,
        transport: str = "tcp",
        log: LogFile | None = None,
    ) -> None:
        """Make a publisher on ``topic``, a name in the node's namespace.

        Args:
            to: host and port of the receiver.
            policy: name of a registered policy, or a ``Policy``.
            queue_size: L, messages.
            reliable, depth: quality of service at the other end.
            value: V; 1 - 0.618^d by default.
            x: returns the scene's motion now, such as ``bufgym_robot.wire.odometry``; by default it counts messages.
            log: log of every decision.
        """
        package, name = msg_type.__module__.split(".")[0], msg_type.__name__
        self._head = Published(
            node.resolve_topic_name(topic), f"{package}/msg/{name}", reliable=reliable, depth=depth
        ).head()
        self._x = x
        self.queue = PolicyQueue(policy, queue_size, value=value, log=log)
        self.sender = Sender(self.queue, lambda: TRANSPORTS[transport](*to))
        self._loop = asyncio.new_event_loop()
        self._sending = self._loop.create_task(self.sender.run())
        self._thread = threading.Thread(target=self._run, name=f"bufgym {topic}", daemon=True)
        self._thread.start()

    def publish(self, message: Any) -> None:
        """Put a message, serialized or not, into the queue; never blocks.

        Raises:
            BufgymError: an earlier message was larger than the receiver takes, which ended the sending.
        """
        with needs_rclpy():
            from rclpy.serialization import serialize_message
        if self._sending.done():
            self._sending.result()
        data = self._head + (message if isinstance(message, bytes) else serialize_message(message))
        self.queue.put(data, len(data), self._x())

    def destroy(self, drain_s: float = 0.0) -> None:
        """Stop the publisher; queued messages are still sent for up to ``drain_s``."""
        self.queue.close()
        self._thread.join(drain_s)
        self._loop.call_soon_threadsafe(self._sending.cancel)
        self._thread.join()
        self._loop.close()

    def _run(self) -> None:
        self._loop.run_until_complete(asyncio.wait([self._sending]))
