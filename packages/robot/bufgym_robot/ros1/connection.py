"""Connection of one subscriber with a queue ruled by a policy, in place of rospy's ``QueuedConnection``.

rospy's own sender takes its whole queue at once and writes it into a socket whose buffers grow to megabytes, where
nothing can be dropped any more. This one takes one message at a time from a ``PolicyQueue``, and the next when the
system has sent nearly all of it, whatever is still in flight.
"""

import contextlib
import threading
from collections.abc import Callable
from typing import Any, Final

from bufgym_robot import LogFile, PolicyQueue
from bufgym_robot.channels import PIECE_BYTES
from bufgym_robot.wire.sockets import BACKOFF_S, bounded_backoff, is_writable, little_unsent, set_option, unsent_bytes

_LOOK_S: Final = 0.1  # Time between two looks at whether the connection was closed
_DEAD_AFTER_S: Final = 900.0
"""Time without acks after which the connection ends. The subscriber alone can connect again, and is not told."""


class PolicyConnection:
    """Behaves like rospy's connection, and delegates to it everything except the queue."""

    def __init__(
        self,
        connection: Any,
        queue: PolicyQueue,
        x: Callable[[], float | None] = lambda: None,
        log: LogFile | None = None,
        backoff_s: float = BACKOFF_S,
    ) -> None:
        """``connection`` is a ``TCPROSTransport``, ``x`` gives the coordinate now, and ``log`` is closed at the end.

        ``backoff_s`` is the longest time between two tries of TCP at a dead link.
        """
        self._connection = connection
        self.queue = queue
        self._x = x
        self._log = log
        self._error: Exception | None = None
        self._unwritten_bytes = 0
        queue.left_bytes = self._left_bytes
        with contextlib.suppress(OSError):  # it may be closed by now
            little_unsent(connection.socket)
            if bounded_backoff(connection.socket, backoff_s):  # 15 tries, the kernel's limit, would last 14 s
                set_option(connection.socket, "TCP_USER_TIMEOUT", round(_DEAD_AFTER_S * 1000))
        connection.set_cleanup_callback(lambda _: queue.close())
        self._thread = threading.Thread(target=self._run, name=f"{connection.name} to {connection.endpoint_id}")
        self._thread.start()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._connection, name)

    def write_data(self, data: bytes) -> bool:
        """Put a serialized message into the queue; never blocks.

        Raises:
            Exception: the error of the last message sent, as from rospy's own connection.
        """
        if self._error is not None:
            error, self._error = self._error, None
            raise error
        if not self._connection.done:
            self.queue.put(data, len(data), self._x())
        return True

    def _run(self) -> None:
        """Send what the queue returns, until the connection is closed."""
        try:
            while not self._connection.done and (item := self.queue.get()) is not None:
                try:
                    self._send(memoryview(item.message))
                except Exception as error:
                    self._error = error
                self.queue.gone()
        finally:
            if self._log is not None:
                self._log.close()

    def _send(self, message: memoryview) -> None:
        """Send a message and wait until the system wants more."""
        connection = self._connection
        messages = connection.stat_num_msg
        self._unwritten_bytes = len(message)
        try:
            for start in range(0, len(message), PIECE_BYTES):
                piece = message[start : start + PIECE_BYTES]
                connection.write_data(piece)
                connection.stat_num_msg = messages  # rospy counts each write as a message
                self._unwritten_bytes -= len(piece)
            connection.stat_num_msg = messages + 1
        finally:
            self._unwritten_bytes = 0
        with contextlib.suppress(OSError, ValueError, AttributeError):  # it is closed by now
            while not connection.done and not is_writable(connection.socket, _LOOK_S):
                pass

    def _left_bytes(self) -> int | None:
        unsent = unsent_bytes(self._connection.socket)
        return None if unsent is None else self._unwritten_bytes + unsent
