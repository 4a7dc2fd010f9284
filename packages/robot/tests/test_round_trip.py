"""Senders over a round trip: the next message goes when the system wants more, or as many as the path holds.

A link with a delay needs two network namespaces (``bufgym_robot.tunnel``), and so root.
"""

import asyncio
import contextlib
import os
import socket
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live_cases import Channel, meeting_port
from loop_cases import beside, until
from needs import needs
from ros1_cases import played

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.scenario import Episode, messages
from bufgym.sim import outcome, run
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError
from bufgym_robot import PolicyQueue, far, tunnel
from bufgym_robot.frames import ACK, Frame
from bufgym_robot.path_window import PathWindow
from bufgym_robot.sender import Sender
from bufgym_robot.wire import sockets

V = qoi.exponential(0.618)
REPO = Path(__file__).resolve().parents[3]
NO_TUNNEL = "tunnel" if "the command ip" in tunnel.impossible() else "root", tunnel.impossible()
in_namespaces = pytest.mark.skipif(bool(NO_TUNNEL[1]), reason=needs(*NO_TUNNEL))


# --- how many messages fill a path -----------------------------------------------------------------------------------


def test_messages_that_fill_the_path() -> None:
    """230 kB at 3 MB/s take 76.7 ms each, and the round trip 100 ms: 1.3 of them, and the one that is being sent."""
    window = PathWindow(0.1)
    assert window.messages == 1  # nothing is known yet
    window.sends(0, 0.0)
    window.acked(0, 230_000, 0.1767)  # the round trip and its own bytes: .97 (1 + .1 / .1767) = 1.52
    assert window.messages == 2
    for number in range(1, 10):  # the next ones come at the link's rate: .97 (1 + .1 / .0767) = 2.23
        window.sends(number, 0.0)
        window.acked(number, 230_000, 0.1767 + 0.0767 * number)
    assert window.messages == 3


@pytest.mark.parametrize(("round_trip_s", "messages_"), [(0.0, 1), (0.002, 1), (0.01, 2), (0.5, 8)])
def test_a_short_path_holds_one_message(round_trip_s: float, messages_: int) -> None:
    """Of messages that take 76.7 ms, 2 ms of idle link are not worth a second one that is chosen sooner."""
    window = PathWindow(round_trip_s)
    for number in range(8):
        window.sends(number, 0.0)
        window.acked(number, 230_000, 0.0767 * (number + 1))
    assert window.messages == messages_


# --- congestion control ----------------------------------------------------------------------------------------------


def congestion_control(of: tunnel.End) -> str:
    """That of a new socket at this end."""

    def look() -> None:
        of.enter()
        with socket.socket() as one:
            found.append(one.getsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, 16))

    found = list[bytes]()
    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    return found[0].rstrip(b"\0").decode()


@in_namespaces
def test_congestion_control_of_one_end_alone() -> None:
    """Each Linux has Reno. The other end and the machine keep theirs."""
    machine = congestion_control(tunnel.HERE)
    with tunnel.opened() as through:
        before = congestion_control(through.far)
        through.near.set_congestion_control("reno")
        assert congestion_control(through.near) == "reno"
        assert (congestion_control(through.far), congestion_control(tunnel.HERE)) == (before, machine)
        with pytest.raises(BufgymError, match=r"control 'nonsense': must be one of .*reno"):
            through.near.set_congestion_control("nonsense")
        assert congestion_control(through.near) == "reno"


@in_namespaces
def test_a_table_of_round_trips_without_a_row_is_a_failure() -> None:
    words = ["-m", "studies.round_trips", "--control", "nonsense", "--rtt", "1", "--mbit", "2", "--senders", "tcp"]
    done = subprocess.run([sys.executable, *words], cwd=REPO, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "left out: tcp: congestion control 'nonsense': must be one of " in done.stdout


def test_congestion_control_of_the_whole_machine_is_left_alone() -> None:
    with pytest.raises(BufgymError, match="in a namespace only"):
        tunnel.HERE.set_congestion_control("reno")


# --- when the next message goes --------------------------------------------------------------------------------------


@contextlib.asynccontextmanager
async def over(path: Channel, leaves: Any = "sent", window: int = 1) -> AsyncIterator[PolicyQueue]:
    """Five messages put at once into a queue of eight."""

    async def connect() -> Any:
        return path

    queue = PolicyQueue("drop-oldest", 8, window=window)
    sender = Sender(queue, connect, leaves)
    async with beside(sender.run()):
        await sender.connected.wait()
        for _ in range(5):
            queue.put(b"1", 1)
        yield queue


async def test_the_next_message_goes_when_the_system_wants_more() -> None:
    """No ack ever comes. Each time that the system wants more, one message goes, and no second one is chosen sooner."""
    path = Channel()
    async with over(path) as queue:
        for sent in range(1, 5):
            await until(lambda sent=sent: len(path.sent) == sent)  # type: ignore[misc]
            assert (len(queue), queue.in_flight) == (5 - sent, 1)
            path.wanted.release()


async def test_a_hidden_socket_gets_as_many_as_the_path_holds() -> None:
    """Where a library hides its socket, the first ack lets the second message go, and a long round trip more."""
    path = Channel(hidden=True)
    async with over(path) as queue:
        await until(lambda: path.sent == [0])
        assert (len(queue), queue.in_flight) == (4, 1)
        path.answers.put_nowait(Frame(ACK, 0))
        await until(lambda: path.sent[:2] == [0, 1])


async def test_a_fixed_window_waits_for_acks() -> None:
    """Robofleet's n_T = 2: two go, and a third when the first is acked, whatever the system wants."""
    path = Channel()
    async with over(path, "acked", 2) as queue:
        await until(lambda: path.sent == [0, 1])
        assert (len(queue), queue.in_flight) == (3, 2)
        path.answers.put_nowait(Frame(ACK, 0))
        await until(lambda: path.sent == [0, 1, 2])


# --- what the kernel says --------------------------------------------------------------------------------------------


@contextlib.contextmanager
def connected() -> Iterator[tuple[socket.socket, socket.socket]]:
    """A TCP connection over loopback: the sender's end, and one that reads nothing by itself."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        ours = socket.create_connection(server.getsockname())
        theirs, _ = server.accept()
    with ours, theirs:
        sockets.little_unsent(ours)
        ours.setblocking(False)
        yield ours, theirs


async def test_a_socket_is_writable_when_little_is_unsent() -> None:
    """Filled until it takes no more, it wants more once its peer has read what is in flight."""
    with connected() as (ours, theirs):
        with contextlib.suppress(BlockingIOError):
            while True:
                ours.send(bytes(100_000))
        assert not sockets.is_writable(ours, 0.0)
        unsent = sockets.unsent_bytes(ours)
        assert unsent is None or unsent >= sockets.UNSENT_BYTES // 2
        waiting = asyncio.create_task(sockets.until_writable(ours))
        while not waiting.done():
            await asyncio.to_thread(theirs.recv, 2**20)
        assert sockets.is_writable(ours, 0.0)
    assert sockets.unsent_bytes(ours) is None  # closed


# --- a link with a round trip ----------------------------------------------------------------------------------------


def packet(payload: int, protocol: int = 6) -> bytes:
    """IPv4 of 20 bytes, TCP of 32 with its options (or UDP of 8), and the payload."""
    head = bytearray(20 + (32 if protocol == 6 else 8))
    head[0], head[9] = 0x45, protocol
    if protocol == 6:
        head[20 + 12] = 8 << 4
    return bytes(head) + bytes(payload)


def test_the_payload_of_packets() -> None:
    assert [tunnel.payload_bytes(packet(size)) for size in (0, 1, 1448)] == [0, 1, 1448]
    assert tunnel.payload_bytes(packet(100, protocol=17)) == 108  # all behind IPv4's header
    assert tunnel.payload_bytes(b"\x60" + bytes(60)) == 0  # IPv6, of which the link needs nothing
    assert tunnel.payload_bytes(b"\x45") == 0


def test_when_packets_arrive() -> None:
    """1 MB/s and 50 ms each way; the bottleneck's buffer holds 2,200 bytes, which are two packets with their heads."""
    now = [10.0]
    carrier = tunnel._Carrier(Link(Trace.constant(1e6, duration_s=9), 0, 50_000), 2_200, clock=lambda: now[0])
    for _ in range(3):
        carrier.sent(1, packet(1000))  # 1 ms each; the third does not fit
    carrier.sent(1, packet(0))  # an ack: no payload, behind those before it
    carrier.returned(2, packet(0))
    arrived = []
    for at_ms in (49, 50, 51, 52, 53):
        now[0] = 10 + at_ms / 1000 + 1e-6
        arrived.append((len(list(carrier.due(1))), len(list(carrier.due(2)))))
    assert arrived == [(0, 0), (0, 1), (1, 0), (2, 0), (0, 0)]
    carrier.sent(1, packet(1000))  # an idle link begins now
    assert carrier.wait_s() == pytest.approx(0.05)  # as long as it waits at most; the packet comes after 51 ms
    now[0] += 0.051
    assert len(list(carrier.due(1))) == 1 and carrier.wait_s() == pytest.approx(0.05)


def stream(seconds: float, round_trip_ms: float) -> Episode:
    """30 frames of 230 kB a second over 24 Mbit/s, which carries 13 of them."""
    times = np.arange(round(30 * seconds)) * 33_333
    link = Link(Trace.constant(3e6, duration_s=60), 0, round(500 * round_trip_ms))
    return Episode(messages(times, 230_000), link)


@in_namespaces
def test_a_round_trip_leaves_no_link_idle() -> None:
    """2 s over 100 ms. By one message per ack 177 ms go by for each of 77 ms: fewer than two thirds arrive."""
    episode, afr = stream(2, 100), policies.get("afr")
    with tunnel.opened() as through:
        ours, acked = (len(far.over(through, "tcp")(afr, episode, 8, V, leaves=name)) for name in ("sent", "acked"))
    simulated = outcome(run(afr, [episode], 8, V), 0).delivered
    print("delivered:", ours, "by acks:", acked, "simulated:", simulated)
    assert ours > 1.2 * acked
    assert ours > 0.7 * simulated  # TCP's window grows from nothing in the first second


@in_namespaces
@pytest.mark.nightly
@pytest.mark.parametrize("transport", ["tcp", "websocket", "zenoh", "ros1", "ros2"])
def test_every_transport_as_in_the_simulator(transport: str, request: pytest.FixtureRequest) -> None:
    """12 s over 1, 50 and 150 ms. On a quiet machine counts differ by what TCP's start costs: some round trips."""
    where = request.getfixturevalue("ros") if transport == "ros1" else {**os.environ, "PYTHONPATH": str(REPO)}
    if transport == "ros2":
        pytest.importorskip("rclpy", reason=needs("ros2", "rclpy"))
    meeting_port(transport, request)
    words = ["--rtt", 1, 50, 150, "--mbit", 24, "--seconds", 12, "--senders", transport]
    rows = [row.split() for row in played(where, "-m", "studies.round_trips", *words).splitlines() if "measured" in row]
    print(rows)
    for *_, count, information, _, _, _, simulated_count, simulated, _ in rows:
        assert int(count) > 0.9 * int(simulated_count) and float(information) > 0.93 * float(simulated)


def test_where_no_namespace_can_be_made(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Without root a proxy delays the acks, and says what it cannot show."""
    from bufgym.cli import main

    monkeypatch.setattr(tunnel, "impossible", lambda: "it needs root")
    words = ["--trace", "lte-synthetic-0", "--policies", "afr", "--duration", "0.5", "--size", "5000", "--speed", "4"]
    assert main(["live", "validate", *words, "--rtt", "20"]) == 0
    out = capsys.readouterr().out
    assert "round trip 20 ms" in out and "it needs root" in out and "cannot show" in out
