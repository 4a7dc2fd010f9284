"""ROS 1: the queue inside rospy under a policy, its interface unchanged.

    import bufgym.ros1

    bufgym.ros1.install(policy="afr")  # before the first subscriber comes; the node stays as it is
    publisher = rospy.Publisher("/camera", Image, queue_size=15)

or, for a node that is not touched at all,

    python -m bufgym.ros1 --policy learned-motion --odom /odom NODE.py ARGS

``queue_size`` is L, and each subscriber has a queue of its own. Publishers without one (rospy then sends at once, in
``publish``), with ``queue_size=0`` (no end) and the topics of ``UNTOUCHED`` stay rospy's.
"""

from __future__ import annotations

import itertools
import math
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from bufgym.errors import BufgymError
from bufgym.live import LogFile, PolicyQueue
from bufgym.live.odometry import Odometry
from bufgym.model import qoi
from bufgym.model.buffer import MAX_CAPACITY
from bufgym.model.qoi import Value
from bufgym.policies.registry import Policy
from bufgym.ros1.connection import PolicyConnection
from bufgym.traces import MotionSettings

UNTOUCHED: Final = ("/rosout", "/tf", "/tf_static", "/clock")
"""Small, and read by all; a policy that is named for one of them rules it all the same."""
_ROOM: Final = 4096
"""Of a queue's bookkeeping: half a MB for each subscriber."""


@contextmanager
def needs_rospy() -> Iterator[None]:
    """An error that says how to get ROS 1 where the block cannot import it."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = f"python3-{(error.name or 'rospy').split('.')[0].replace('_', '-')}"
        raise BufgymError(
            f"bufgym.ros1 needs {error.name}: ROS 1's own, or Debian's {package}, and a Python that sees it"
        ) from None


def install(
    policy: str | Policy | None = "afr",
    *,
    topics: Mapping[str, str | Policy | None] | None = None,
    odometry: str | None = None,
    motion: MotionSettings | None = None,
    value: Value | None = None,
    log: str | Path | None = None,
) -> None:
    """From now on, queues of this process's publishers are ruled by ``policy``.

    Args:
        policy: a registered policy by name, or a ``Policy``; None: rospy's own queue.
        topics: other policies for single topics, by their resolved names ("/camera/image").
        odometry: a topic with poses (Odometry, PoseStamped and the like), which gives x: how far the scene has moved
            on. None: x counts messages.
        motion: the camera's field of view and the scene's scale, for ``odometry``.
        value: V (default: 1 - 0.618^d over messages, 1 - e^-d over motion).
        log: a folder that takes a log of each queue, ``TOPIC-K.mcap``.

    Raises:
        BufgymError: rospy is not there, or no such policy, or one that no live queue can have.
    """
    with needs_rospy():
        from rospy import topics as rospy_topics
        from rospy.impl.tcpros_pubsub import QueuedConnection
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
    moved = None if odometry is None else _Subscribed(odometry, Odometry(motion))
    numbers = itertools.count()

    def queued(connection: Any, queue_size: int) -> Any:
        """What rospy wraps a new subscriber's connection in."""
        ruling = chosen.get(connection.name, policy)
        if ruling is None or queue_size < 1:
            return QueuedConnection(connection, queue_size)
        file = None if log is None else _log_file(Path(log), connection.name, next(numbers))
        queue = PolicyQueue(ruling, min(queue_size, MAX_CAPACITY), value=value, log=file, room=_ROOM)
        if moved is None:
            return PolicyConnection(connection, queue, log=file)
        moved.subscribe()
        return PolicyConnection(connection, queue, moved.x, file)

    rospy_topics.QueuedConnection = queued


def _warm_up(policy: Any, value: Value) -> None:
    """Errors and compiling come now, not with the first subscriber."""
    queue = PolicyQueue(policy, 1, value=value, room=_ROOM)
    for _ in range(3):
        queue.put(None, 1)
    queue.get()
    queue.gone()


def _log_file(folder: Path, topic: str, number: int) -> LogFile:
    return LogFile(folder / f"{topic.strip('/').replace('/', '_')}-{number}.mcap")


class _Subscribed:
    """Odometry from a topic of any type that has a pose, subscribed once there is a queue that needs it."""

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
