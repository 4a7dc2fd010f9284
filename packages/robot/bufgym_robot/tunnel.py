"""A link with a round trip between two network namespaces, so that the system's own TCP meets the delay.

A proxy in user space ends TCP (``shaped.ShapedLink``), so a sender's kernel never sees the delay behind it. Here
packets cross between two tun devices, one in each namespace. A program between them forwards each packet when the
simulator's link has carried its payload, a propagation delay later. The bottleneck's buffer holds a limited number of
bytes and drops what does not fit, as a router does.

The namespaces have no names and no way out, and vanish with the programs that use them. Making them needs root,
``/dev/net/tun`` and the command ``ip``.
"""

from __future__ import annotations

import ctypes
import errno
import os
import select
import shutil
import struct
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import AbstractContextManager, closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from bufgym.model.link import FOREVER, Link
from bufgym.utils.errors import BufgymError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from multiprocessing.connection import Connection

ADDRESSES: Final = ("10.79.0.1", "10.79.0.2")
"""Of the near end, where the robot is, and of the far end. They exist inside the namespaces alone."""
BUFFER_BYTES: Final = 200_000  # Size of the bottleneck's buffer, bytes of packets
_CONTROL: Final = Path("/proc/sys/net/ipv4/tcp_congestion_control")
_CLONE_NEWNET: Final = 0x40000000
_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_PACKET_BYTES: Final = 2_000
_LONGEST_WAIT_S: Final = 0.05


def impossible() -> str:
    """Why no tunnel can be made here; empty if it can."""
    if os.name != "posix" or os.geteuid() != 0:
        return "a link with a round trip needs root, for network namespaces"
    if not os.path.exists("/dev/net/tun"):
        return "a link with a round trip needs /dev/net/tun"
    return "" if shutil.which("ip") else "a link with a round trip needs the command ip (Debian's iproute2)"


@dataclass(frozen=True)
class End:
    """One end: a network namespace with a tun device."""

    address: str
    namespace: int | None = None
    """File descriptor of the namespace; None where the program is already."""
    device: int = -1
    """File descriptor of the tun device, whose packets are read and written by ``Tunnel.carry``."""

    def enter(self) -> None:
        """Move this thread, and all that it starts, into the namespace."""
        if self.namespace is not None:
            _call("setns", self.namespace, _CLONE_NEWNET)

    def set_congestion_control(self, name: str) -> None:
        """Have TCP connections of this namespace use ``name`` from now on; all others of the machine keep theirs.

        Raises:
            BufgymError: the system has no such one.
        """
        if self.namespace is None:
            raise BufgymError("congestion control: can be set in a namespace only, not for the whole machine")

        def write() -> None:
            self.enter()
            with suppress(OSError):
                _CONTROL.write_text(name)
            found.append(_CONTROL.read_text().strip())

        found = list[str]()
        thread = threading.Thread(target=write)  # which ends in the namespace
        thread.start()
        thread.join()
        if found != [name]:
            known = _CONTROL.with_name("tcp_available_congestion_control").read_text().split()
            raise BufgymError(f"congestion control {name!r}: must be one of {', '.join(known)}")


def congestion_control() -> str:
    """The congestion control that this machine's TCP uses."""
    return _CONTROL.read_text().strip()


HERE: Final = End("127.0.0.1")
"""Both ends where there is no tunnel."""


def ends(tunnel: Tunnel | None) -> tuple[End, End]:
    """The near and the far end of a tunnel, or twice ``HERE``."""
    return (HERE, HERE) if tunnel is None else (tunnel.near, tunnel.far)


class Tunnel:
    """Two namespaces, ``near`` and ``far``, and the devices between which ``carry`` forwards packets."""

    def __init__(self) -> None:
        if reason := impossible():
            raise BufgymError(reason)
        self.near, self.far = (_end(address) for address in ADDRESSES)

    def close(self) -> None:
        """Give both ends up; they vanish when the last program in them ends."""
        for end in (self.near, self.far):
            os.close(end.device)
            if end.namespace is not None:
                os.close(end.namespace)

    def carry(self, link: Link, words: Connection) -> None:
        """Forward packets until the process is ended; a number that comes as words is the link's beginning, s.

        Packets from the far end are delayed only, by the link's propagation delay.
        """
        carrier = _Carrier(link, BUFFER_BYTES)
        devices = {self.near.device: carrier.sent, self.far.device: carrier.returned}
        # A packet that came from one end goes to the other.
        others = {self.near.device: self.far.device, self.far.device: self.near.device}
        while True:
            if words.poll():
                carrier.begin(words.recv())
            for device, other in others.items():
                for packet in carrier.due(device):
                    _write(other, packet)
            ready, _, _ = select.select(list(devices), [], [], carrier.wait_s())
            for device in ready:
                for packet in _read(device):
                    devices[device](device, packet)


def opened() -> AbstractContextManager[Tunnel]:
    """Open a tunnel for a block.

    Raises:
        BufgymError: there can be none here; the error says why.
    """
    return closing(Tunnel())


class _Carrier:
    """Says when each packet arrives at the other end."""

    def __init__(self, link: Link, buffer_bytes: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._link, self._buffer_bytes, self._clock = link, buffer_bytes, clock
        self._waiting: dict[int, deque[tuple[float, bytes]]] = {}
        self._buffered: deque[tuple[float, int]] = deque()
        """When a packet has crossed the bottleneck, and its bytes."""
        self._buffered_bytes = 0
        self.begin(clock())

    def begin(self, began_s: float) -> None:
        """Begin the trace at this time."""
        self._began_s, self._position = began_s, 0

    def sent(self, device: int, packet: bytes) -> None:
        """Take a packet towards the far end."""
        now_s = self._clock()
        while self._buffered and self._buffered[0][0] <= now_s:
            self._buffered_bytes -= self._buffered.popleft()[1]
        if self._buffered_bytes + len(packet) > self._buffer_bytes:
            return  # dropped, as a router's full buffer does
        crossed_s = self._crossed_s(now_s, payload_bytes(packet))
        self._buffered.append((crossed_s, len(packet)))
        self._buffered_bytes += len(packet)
        self._put(device, crossed_s, packet)

    def returned(self, device: int, packet: bytes) -> None:
        """Take a packet on its way back."""
        self._put(device, self._clock(), packet)

    def due(self, device: int) -> Iterator[bytes]:
        """Packets from this device that have arrived by now."""
        waiting, now_s = self._waiting.get(device, deque()), self._clock()
        while waiting and waiting[0][0] <= now_s:
            yield waiting.popleft()[1]

    def wait_s(self) -> float:
        """Time until the next packet arrives."""
        next_s = min((waiting[0][0] for waiting in self._waiting.values() if waiting), default=float("inf"))
        return min(_LONGEST_WAIT_S, max(0.0, next_s - self._clock()))

    def _put(self, device: int, crossed_s: float, packet: bytes) -> None:
        self._waiting.setdefault(device, deque()).append((crossed_s + self._link.propagation_us / 1e6, packet))

    def _crossed_s(self, now_s: float, size_bytes: int) -> float:
        """Time at which the link has carried these bytes; those of headers cost nothing, as in the simulator."""
        if size_bytes == 0:
            return max(now_s, self._buffered[-1][0]) if self._buffered else now_s
        carried = self._link.carried_at(max(0, int((now_s - self._began_s) * 1e6)))
        self._position = max(self._position, carried) + size_bytes
        crossed_us = self._link.time_at(self._position)
        return float("inf") if crossed_us == FOREVER else self._began_s + crossed_us / 1e6


def payload_bytes(packet: bytes) -> int:
    """Bytes that a packet carries for its program: those behind the headers of IPv4 and TCP."""
    if len(packet) < 20 or packet[0] >> 4 != 4:
        return 0
    head = (packet[0] & 15) * 4
    if packet[9] == _TCP and len(packet) > head + 12:
        head += (packet[head + 12] >> 4) * 4
    return max(0, len(packet) - head)


_TCP: Final = 6


def _end(address: str) -> End:
    """Make a namespace with a device of this address, in a thread that ends with it."""
    made: list[End | BufgymError] = []

    def make() -> None:
        try:
            _call("unshare", _CLONE_NEWNET)
            device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
            _attach(device, "bufgym0")
            for words in (
                f"addr add {address}/24 dev bufgym0",
                "link set bufgym0 up txqueuelen 1000",
                "link set lo up",
            ):
                subprocess.run(["ip", *words.split()], check=True, capture_output=True)
            made.append(End(address, os.open("/proc/thread-self/ns/net", os.O_RDONLY), device))
        except (OSError, subprocess.CalledProcessError) as error:
            made.append(BufgymError(f"no network namespace can be made here: {error}"))

    thread = threading.Thread(target=make)
    thread.start()
    thread.join()
    if isinstance(made[0], BufgymError):
        raise made[0]
    return made[0]


def _attach(device: int, name: str) -> None:
    import fcntl

    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TUN | _IFF_NO_PI))


def _call(name: str, *arguments: int) -> None:
    """Call a function of the C library that returns 0."""
    if getattr(ctypes.CDLL(None, use_errno=True), name)(*arguments) != 0:
        code = ctypes.get_errno()
        raise OSError(code, f"{name}: {os.strerror(code)}")


def _read(device: int) -> Iterator[bytes]:
    """Packets that wait on the device."""
    while True:
        try:
            yield os.read(device, _PACKET_BYTES)
        except BlockingIOError:
            return


def _write(device: int, packet: bytes) -> None:
    try:
        os.write(device, packet)
    except OSError as error:  # the other end is full, or its device is down: the packet is lost
        if error.errno not in (errno.EAGAIN, errno.EIO, errno.ENOBUFS):
            raise
