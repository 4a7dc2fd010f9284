"""A publisher for one's own ROS 2 node, whose queue a policy rules.

    camera = bufgym.ros2.Publisher(node, Image, "/camera", policy="afr", queue_size=15)
    camera.publish(image)  # never blocks

DDS gets one message at a time, reliably, and the next one when all reliable subscribers have acked it
(``wait_for_all_acked``): its own history holds nothing that the policy could not drop.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Final

from bufgym.live import LogFile, PolicyQueue
from bufgym.model.qoi import Value
from bufgym.policies.registry import Policy
from bufgym.ros2.names import needs_rclpy

_WAIT_S: Final = 0.5
"""At a time, so that ``destroy`` is heard."""


class Publisher:
    """See the module's text."""

    def __init__(
        self,
        node: Any,
        msg_type: type,
        topic: str,
        *,
        policy: str | Policy = "afr",
        queue_size: int = 10,
        value: Value | None = None,
        x: Callable[[], float | None] = lambda: None,
        log: LogFile | None = None,
    ) -> None:
        """A publisher on ``topic``.

        Args:
            policy: a registered policy by name, or a ``Policy``.
            queue_size: L, messages.
            value: V (default: 1 - 0.618^d).
            x: how far the scene has moved on now; by default it counts messages. ``bufgym.live.odometry`` has one.
            log: takes every decision.
        """
        with needs_rclpy():
            from rclpy.qos import QoSProfile, ReliabilityPolicy
        self.queue = PolicyQueue(policy, queue_size, value=value, log=log)
        self._x = x
        self._node = node
        self._publisher = node.create_publisher(
            msg_type, topic, QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
        )
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"bufgym {topic}", daemon=True)
        self._thread.start()

    def publish(self, message: Any) -> None:
        """A message (or a serialized one) arrives at the queue. Never blocks."""
        from rclpy.serialization import serialize_message

        data = message if isinstance(message, bytes) else serialize_message(message)
        self.queue.put(data, len(data), self._x())

    def get_subscription_count(self) -> int:
        """Subscribers that have been found."""
        return int(self._publisher.get_subscription_count())

    def destroy(self) -> None:
        """Drop what is queued, and end."""
        self._ended.set()
        self.queue.close()
        self._thread.join()
        self._node.destroy_publisher(self._publisher)

    def _run(self) -> None:
        from rclpy.duration import Duration

        patience = Duration(seconds=_WAIT_S)
        while not self._ended.is_set() and (item := self.queue.get()) is not None:
            self._publisher.publish(item.message)
            while not self._publisher.wait_for_all_acked(patience) and not self._ended.is_set():
                pass
            self.queue.gone()
