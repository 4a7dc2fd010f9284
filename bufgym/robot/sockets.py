"""A sender's TCP socket that hides no queue.

The system's default buffers take megabytes at once, and no policy can drop messages in them. So the socket gets a small
send buffer, and TCP_NOTSENT_LOWAT limits unsent bytes in the kernel. ``unacked_bytes`` reads from SIOCOUTQ how much the
peer's kernel has not acked.
"""

import asyncio
import socket
import struct
import sys
from typing import Final

SEND_BUFFER_BYTES: Final = 32_768
UNSENT_BYTES: Final = 16_384  # TCP_NOTSENT_LOWAT, the unsent bytes that may wait in the kernel
DEAD_AFTER_S: Final = 20.0  # Time without acks after which a connection is given up, where the system can tell


def unacked_bytes(connection: socket.socket) -> int | None:
    """Bytes in the kernel's send queue, sent or not; None where the system lacks SIOCOUTQ."""
    if not sys.platform.startswith("linux"):
        return None
    import fcntl
    import termios

    try:
        return int(struct.unpack("i", fcntl.ioctl(connection.fileno(), termios.TIOCOUTQ, b"\0\0\0\0"))[0])
    except (OSError, ValueError):  # it is closed
        return None


def small_buffers(connection: socket.socket) -> None:
    """Set a sender's socket so that little waits in the system."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
    set_option(connection, "TCP_NOTSENT_LOWAT", UNSENT_BYTES)


def set_option(connection: socket.socket, option: str, number: int) -> None:
    """Set an option of TCP, where the system has it."""
    if hasattr(socket, option):
        connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), number)


async def connected(host: str, port: int, small: bool = True) -> socket.socket:
    """Connect a sender's TCP socket."""
    loop = asyncio.get_running_loop()
    family, kind, protocol, _, address = (await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM))[0]
    connection = socket.socket(family, kind, protocol)
    try:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if small:
            small_buffers(connection)
            set_option(connection, "TCP_USER_TIMEOUT", round(DEAD_AFTER_S * 1000))
        await loop.sock_connect(connection, address)
    except BaseException:
        connection.close()
        raise
    return connection


def free_port(host: str) -> int:
    """Find a port on which nobody listens."""
    with socket.socket() as free:
        free.bind((host, 0))
        return int(free.getsockname()[1])
