"""A sender's TCP socket that hides no queue and still fills the link at any round trip.

The system's default buffers take megabytes at once, and no policy can drop messages in them. TCP_NOTSENT_LOWAT limits
only bytes that the kernel has not sent: the socket becomes writable when they fall below it, whatever is still in
flight. So the next message is chosen late, and the link never waits for an ack. A small send buffer (SO_SNDBUF) would
limit bytes in flight instead, to one buffer a round trip.
"""

import asyncio
import contextlib
import errno
import os
import select
import socket
import stat
import struct
import sys
from collections.abc import Callable
from contextvars import ContextVar
from ipaddress import ip_address
from typing import Any, Final, NamedTuple

UNSENT_BYTES: Final = 16_384  # TCP_NOTSENT_LOWAT, the unsent bytes that may wait in the kernel
NEXT_ADDRESS_S: Final = 1.0  # Time for one of a host's addresses to answer before the next is tried
DEAD_AFTER_S: Final = 20.0  # Time without acks after which a connection is given up, where the system can tell
BACKOFF_S: Final = 1.0  # Longest time between two tries of TCP at a dead link; the system's own grows to 120 s
LEAST_BACKOFF_S: Final = 1.0  # The kernel takes 1 to 120 s
MOST_BACKOFF_S: Final = 120.0
_CONNECT_S: Final = 3.0  # Time for a new connection; TCP asks again after 1 and 3 s
_UNBOUNDED_DEAD_AFTER_S: Final = 5.0  # DEAD_AFTER_S where the kernel cannot bound its backoff: a new connection is soon
_TCP_RTO_MAX_MS: Final = 44  # of linux/tcp.h, from Linux 6.15 on; Python's socket lacks it
_SIOCOUTQNSD: Final = 0x894B  # of linux/sockios.h; Python's termios lacks it
_TCP_INFO: Final = struct.Struct("=16xI4xI24x2I60xQ")
"""Of linux/tcp.h: bytes of a segment, segments in flight, ms since data and since an ack, bytes acked."""
_SIOCOUTQ: Final = 0x5411

PACKET_BYTES: Final[ContextVar[int | None]] = ContextVar("packet_bytes", default=None)
"""Largest packet of a connection that is made, both ways; None: as large as the interface takes."""


def unsent_bytes(connection: socket.socket) -> int | None:
    """Bytes in the kernel that were not sent yet; None where the system does not tell.

    SIOCOUTQ would count bytes in flight as well, which no decision can change.
    """
    return _queued_bytes(connection, _SIOCOUTQNSD)


def _queued_bytes(connection: socket.socket, request: int) -> int | None:
    if not sys.platform.startswith("linux"):
        return None
    import fcntl

    try:
        return int(struct.unpack("i", fcntl.ioctl(connection.fileno(), request, b"\0\0\0\0"))[0])
    except (OSError, ValueError):  # it is closed
        return None


class Heard(NamedTuple):
    """What the system has heard of a connection's other end."""

    silent_s: float
    """Time since anything came: an ack of TCP, or data."""
    in_flight: bool
    waiting_bytes: int
    """Bytes not acked, sent or not."""
    full: bool
    """Whether as much as a full segment was acked."""


def heard(connection: socket.socket) -> Heard | None:
    """Ask the system; None where it does not tell, or once the connection is closed."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        told = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO.size)
        mss, in_flight, data_ms, ack_ms, acked_bytes = _TCP_INFO.unpack(told)
    except (OSError, struct.error):  # it is closed, or the kernel is older than 4.1
        return None
    waiting_bytes = _queued_bytes(connection, _SIOCOUTQ) or 0
    return Heard(min(data_ms, ack_ms) / 1000, in_flight > 0, waiting_bytes, acked_bytes > mss)


def segment_bytes(connection: socket.socket, packet_bytes: int) -> int:
    """TCP's MSS for packets of this size."""
    return packet_bytes - (60 if connection.family == socket.AF_INET6 else 40)


def drop_unacked(connection: socket.socket) -> None:
    """Have the system forget at the close what was not acked; otherwise it repeats that for DEAD_AFTER_S."""
    with contextlib.suppress(OSError):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))


def little_unsent(connection: socket.socket) -> None:
    """Set a sender's socket so that little waits unsent in the system, and small packets go at once."""
    set_option(connection, "TCP_NOTSENT_LOWAT", UNSENT_BYTES)
    set_option(connection, "TCP_NODELAY", 1)


def bounded_backoff(connection: socket.socket, most_s: float) -> bool:
    """Let TCP try a dead link again after ``most_s`` at the latest; False where the system cannot (Linux before 6.15).

    After 20 s without a link the kernel's retransmission timer stands at 15 to 20 s, in which nobody sends.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        connection.setsockopt(socket.IPPROTO_TCP, _TCP_RTO_MAX_MS, round(1000 * most_s))
    except OSError:
        return False
    return True


def address_to(peer: Any, family: int = socket.AF_INET) -> str | None:
    """This machine's address from which a new connection to the peer would leave; None if no way leads there."""
    with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.connect(peer)  # which sends nothing
        return str(probe.getsockname()[0])
    return None


def moved_to(connection: socket.socket) -> str | None:
    """This machine's new address, if a connection that it made would now leave from another one."""
    with contextlib.suppress(OSError):
        new = address_to(connection.getpeername(), connection.family)
        return None if new == connection.getsockname()[0] else new
    return None


def is_gone(address: str) -> bool:
    """Whether no interface of this machine has this address; False for a name."""
    try:
        family = socket.AF_INET6 if ip_address(address).version == 6 else socket.AF_INET
    except ValueError:
        return False
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((address, 0))
        except OSError as error:
            return error.errno == errno.EADDRNOTAVAIL
    return False


async def until_writable(connection: Any) -> None:
    """Wait until the kernel wants more: less than ``UNSENT_BYTES`` are unsent, or the connection has ended."""
    if is_writable(connection, 0.0):
        await asyncio.sleep(0)  # others have a turn all the same
        return
    loop = asyncio.get_running_loop()
    writable = asyncio.Event()
    with connection.dup() as same:  # a transport of asyncio watches the other descriptor
        loop.add_writer(same, writable.set)
        try:
            await writable.wait()
        finally:
            loop.remove_writer(same)


def is_writable(connection: socket.socket, patience_s: float) -> bool:
    """Do ``until_writable`` in a thread, for so long at most; return whether the kernel wants more."""
    poll = select.poll()
    poll.register(connection, select.POLLOUT)
    return bool(poll.poll(patience_s * 1000))


def connections_to(host: str, port: int) -> dict[int, socket.socket]:
    """This process's TCP connections to there, by inode, also those of libraries; none where the system hides them."""
    peers = {address[:2] for *_, address in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)}
    return _connections(lambda one: _peer(one) in peers)


def end_connections_from(address: str) -> None:
    """End this process's TCP connections from this address, which is gone: whoever waits for them learns of it."""
    for one in _connections(lambda one: _peer(one) is not None and one.getsockname()[0] == address).values():
        with one, contextlib.suppress(OSError):
            one.shutdown(socket.SHUT_RDWR)


def _connections(chosen: Callable[[socket.socket], bool]) -> dict[int, socket.socket]:
    """The chosen ones of this process's sockets, each with a new descriptor, by inode."""
    found: dict[int, socket.socket] = {}
    for name in os.listdir("/proc/self/fd") if os.path.isdir("/proc/self/fd") else ():
        with contextlib.suppress(OSError):  # a descriptor that was closed meanwhile
            about = os.stat(f"/proc/self/fd/{name}")
            if stat.S_ISSOCK(about.st_mode) and about.st_ino not in found:
                one = socket.socket(fileno=os.dup(int(name)))
                if one.type == socket.SOCK_STREAM and chosen(one):
                    found[about.st_ino] = one
                else:
                    one.close()
    return found


def _peer(connection: socket.socket) -> tuple[str, int] | None:
    """Address of the other end; None for a socket that has none."""
    with contextlib.suppress(OSError):
        if connection.family in (socket.AF_INET, socket.AF_INET6):
            host, port, *_ = connection.getpeername()
            return host, port
    return None


def set_option(connection: socket.socket, option: str, number: int) -> None:
    """Set an option of TCP, where the system has it."""
    if hasattr(socket, option):
        connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), number)


async def connected(host: str, port: int, small: bool = True, backoff_s: float = BACKOFF_S) -> socket.socket:
    """Connect a sender's TCP socket to the first of the host's addresses that answers; ``localhost`` has two.

    ``small`` and ``backoff_s`` set what waits unsent in the system and how soon it tries a dead link again.
    """
    loop = asyncio.get_running_loop()
    found = await loop.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    while True:
        (family, kind, protocol, _, address), *found = found
        connection = socket.socket(family, kind, protocol)
        try:
            connection.setblocking(False)
            if (packet_bytes := PACKET_BYTES.get()) is not None:
                set_option(connection, "TCP_MAXSEG", segment_bytes(connection, packet_bytes))
            if small:
                little_unsent(connection)
                bounded = bounded_backoff(connection, backoff_s)
                dead_after_s = DEAD_AFTER_S if bounded else max(_UNBOUNDED_DEAD_AFTER_S, backoff_s)
                set_option(connection, "TCP_USER_TIMEOUT", round(dead_after_s * 1000))
            async with asyncio.timeout(NEXT_ADDRESS_S if found else _CONNECT_S):
                await loop.sock_connect(connection, address)
            return connection
        except BaseException as error:
            connection.close()
            if not (found and isinstance(error, OSError)):
                raise


def host_port(host: str, port: int) -> str:
    """Write an address as HOST:PORT, one of IPv6 as [HOST]:PORT."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def free_port(host: str) -> int:
    """Find a port on which nobody listens."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as free:
        free.bind((host, 0))
        return int(free.getsockname()[1])
