"""One subscriber's connection, whose queue a policy rules: what stands where rospy has its ``QueuedConnection``.

rospy's own sender takes its whole queue at once and writes it into a socket whose buffers grow to megabytes: nothing
of that can be dropped any more. This one takes a message at a time from a ``PolicyQueue``, and the next one when the
subscriber's system has acked nearly all of it.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable
from typing import Any, Final

from bufgym.live import LogFile, PolicyQueue
from bufgym.live.channels import PIECE_BYTES
from bufgym.live.sockets import UNSENT_BYTES, small_buffers, unacked_bytes

_POLL_S: Final = 0.001


class PolicyConnection:
    """Behaves as rospy's connection does, and all that is not about the queue is its."""

    def __init__(
        self,
        connection: Any,
        queue: PolicyQueue,
        x: Callable[[], float | None] = lambda: None,
        log: LogFile | None = None,
    ) -> None:
        """``connection``: a ``TCPROSTransport``; ``x``: the coordinate now; ``log``: closed with the connection."""
        self._connection = connection
        self.queue = queue
        self._x = x
        self._log = log
        self._error: Exception | None = None
        self._unwritten_bytes = 0
        queue.left_bytes = self._left_bytes
        with contextlib.suppress(OSError):  # it may be closed by now
            small_buffers(connection.socket)
            connection.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.set_cleanup_callback(lambda _: queue.close())
        self._thread = threading.Thread(target=self._run, name=f"{connection.name} to {connection.endpoint_id}")
        self._thread.start()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._connection, name)

    def write_data(self, data: bytes) -> bool:
        """A serialized message arrives at the queue. Never blocks.

        Raises:
            Exception: that of the last message sent, as rospy's own connection does.
        """
        if self._error is not None:
            error, self._error = self._error, None
            raise error
        if not self._connection.done:
            self.queue.put(data, len(data), self._x())
        return True

    def _run(self) -> None:
        """Send what the queue hands out, until the connection is closed."""
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
        """Returns when a message has left: nearly all of it is acked.

        Nearly, as the subscriber's system delays its last ack by up to 40 ms, which small messages can't wait for.
        """
        connection = self._connection
        messages = connection.stat_num_msg
        self._unwritten_bytes = len(message)
        try:
            for start in range(0, len(message), PIECE_BYTES):
                piece = message[start : start + PIECE_BYTES]
                connection.write_data(piece)
                connection.stat_num_msg = messages  # rospy counts a message for each writing
                self._unwritten_bytes -= len(piece)
            connection.stat_num_msg = messages + 1
        finally:
            self._unwritten_bytes = 0
        while not connection.done and (unacked_bytes(connection.socket) or 0) > UNSENT_BYTES:
            time.sleep(_POLL_S)

    def _left_bytes(self) -> int | None:
        unacked = unacked_bytes(self._connection.socket)
        return None if unacked is None else self._unwritten_bytes + unacked
