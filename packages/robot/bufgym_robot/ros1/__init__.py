"""ROS 1: a policy rules the queue inside rospy, whose interface stays the same.

``install(policy="afr")`` or, for an unmodified node, ``python -m bufgym_robot.ros1 --policy afr NODE.py ARGS``.

``queue_size`` is L, and each subscriber has a queue of its own. Publishers without ``queue_size`` send at once in
``publish``, and ``queue_size=0`` is unbounded. Both, the topics of ``UNTOUCHED`` and latched ones stay rospy's: its own
queue never drops the last message, and each new subscriber gets that.
"""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from bufgym.utils.errors import BufgymError
from bufgym_robot.wire.sockets import BACKOFF_S, LEAST_BACKOFF_S, MOST_BACKOFF_S

if TYPE_CHECKING:  # the command says first whether policies run compiled, and these would import the compiler
    from bufgym.model.qoi import Value
    from bufgym.policies.registry import Policy
    from bufgym.traces import MotionSettings
    from bufgym_robot.wire.odometry import Odometry

UNTOUCHED: Final = ("/rosout", "/tf", "/tf_static", "/clock")
"""Small topics that every node reads. A policy named for one of them still rules it."""
_ROOM: Final = 4096  # size of a queue's bookkeeping, half a MB for each subscriber


@contextmanager
def needs_rospy() -> Iterator[None]:
    """Raise an error that says how to get ROS 1 if the block can't import it."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = f"python3-{(error.name or 'rospy').split('.')[0].replace('_', '-')}"
        raise BufgymError(
            f"bufgym_robot.ros1 needs {error.name}: ROS 1's own, or Debian's {package}, and a Python that sees it"
        ) from None


def install(
    policy: str | Policy | None = "afr",
    *,
    topics: Mapping[str, str | Policy | None] | None = None,
    odometry: str | None = None,
    motion: MotionSettings | None = None,
    value: Value | None = None,
    log: str | Path | None = None,
    backoff_s: float = BACKOFF_S,
) -> None:
    """Put the queues of this process's publishers under ``policy`` from now on.

    Args:
        policy: name of a registered policy, or a ``Policy``; None keeps rospy's own queue.
        topics: other policies for single topics by resolved name, such as "/camera/image".
        odometry: a topic with poses, such as Odometry or PoseStamped, which gives x, the scene's motion. The poses of
            one frame count (TOPIC:FRAME, of tf TOPIC:PARENT:CHILD, else that of the first). None: x counts messages.
        motion: the camera's field of view and the scene's scale, for ``odometry``.
        value: V (default: 1 - 0.618^d over messages, 1 - e^-d over motion).
        log: folder for a log of each queue, ``TOPIC-K.mcap``.
        backoff_s: longest time between two tries of TCP at a dead link, 1 to 120 s (Linux from 6.15 on).

    Raises:
        BufgymError: rospy is not installed, or the policy is unknown or cannot rule a live queue.
    """
    with needs_rospy():
        from rospy import topics as rospy_topics
        from rospy.impl.tcpros_pubsub import QueuedConnection
    from bufgym.model import qoi
    from bufgym.model.buffer import MAX_CAPACITY
    from bufgym.model.checks import between
    from bufgym_robot import LogFile, PolicyQueue
    from bufgym_robot.ros1 import new_address
    from bufgym_robot.ros1.connection import PolicyConnection
    from bufgym_robot.wire.odometry import followed

    between("backoff_s", backoff_s, LEAST_BACKOFF_S, MOST_BACKOFF_S, "s")
    if value is None:
        value = qoi.exponential() if odometry is None else qoi.exponential(math.exp(-1))
    if log is not None:
        Path(log).mkdir(parents=True, exist_ok=True)
    chosen = {**dict.fromkeys(UNTOUCHED), **(topics or {})}
    warmed: list[str | Policy] = []
    for one in (policy, *chosen.values()):
        if one is not None and one not in warmed:
            _warm_up(one, value)
            warmed.append(one)
    moved = None if odometry is None else _Subscribed(*followed(odometry, motion))
    numbers = itertools.count()

    def queued(connection: Any, queue_size: int) -> Any:
        """Wrap a new subscriber's connection; replaces rospy's own wrapper."""
        ruling = chosen.get(connection.name, None if _latched(connection.name) else policy)
        if ruling is None or queue_size < 1:
            return QueuedConnection(connection, queue_size)
        name = f"{connection.name.strip('/').replace('/', '_')}-{next(numbers)}.mcap"
        file = None if log is None else LogFile(Path(log, name))
        queue = PolicyQueue(ruling, min(queue_size, MAX_CAPACITY), value=value, log=file, room=_ROOM)
        if moved is None:
            return PolicyConnection(connection, queue, log=file, backoff_s=backoff_s)
        moved.subscribe()
        return PolicyConnection(connection, queue, moved.x, file, backoff_s)

    rospy_topics.QueuedConnection = queued
    new_address.watch()


def _latched(topic: str) -> bool:
    """Whether this process's publisher of the topic gives its last message to each new subscriber."""
    from rospy.topics import get_topic_manager

    return bool(getattr(get_topic_manager().get_publisher_impl(topic), "is_latch", False))


def _warm_up(policy: Any, value: Value) -> None:
    """Check and compile now instead of at the first subscriber."""
    from bufgym_robot import PolicyQueue

    queue = PolicyQueue(policy, 1, value=value, room=_ROOM)
    for _ in range(3):
        queue.put(None, 1)
    queue.get()
    queue.gone()


class _Subscribed:
    """Odometry from a topic of any type with a pose, subscribed once a queue needs it."""

    def __init__(self, topic: str, odometry: Odometry) -> None:
        self._topic, self._odometry = topic, odometry
        self._lock = threading.Lock()
        self._subscriber: Any = None
        self._types: dict[str, Any] = {}

    def x(self) -> float:
        return self._odometry.x

    def subscribe(self) -> None:
        import rospy

        with self._lock:
            if self._subscriber is None:
                self._subscriber = rospy.Subscriber(self._topic, rospy.AnyMsg, self._take, queue_size=100)

    def _take(self, message: Any) -> None:
        from roslib.message import get_message_class

        name = message._connection_header["type"]
        if name not in self._types:
            self._types[name] = get_message_class(name)
        if self._types[name] is None:
            raise BufgymError(f"{self._topic}: messages of {name}, whose package is not installed")
        self._odometry.take(self._types[name]().deserialize(message._buff))
