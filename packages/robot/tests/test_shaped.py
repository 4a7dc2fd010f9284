"""A shaped link: which way it has its pace, when its trace begins, and when it counts as idle."""

import asyncio
import itertools
import socket

import pytest

from bufgym.model.link import Link
from bufgym.traces import Trace
from bufgym_robot import shaped
from bufgym_robot.shaped import ShapedLink


@pytest.mark.parametrize(("back", "carried_bytes"), [(True, 10**6), (False, 4)])
async def test_a_link_whose_messages_come_back(back: bool, carried_bytes: int) -> None:
    """4 bytes go to who is called, 1 MB comes back. The link carries the one or the other."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(bytes(250_000) * len(await reader.readexactly(4)))
        await writer.drain()
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    link = ShapedLink(Link(Trace.constant(2e7, duration_s=1)), server.sockets[0].getsockname(), back=back)
    reader, writer = await asyncio.open_connection("127.0.0.1", await link.listen())
    writer.write(b"send")
    await reader.readexactly(10**6)
    assert link.carried_bytes == carried_bytes
    writer.close()
    await writer.wait_closed()
    await link.close()
    server.close()
    await server.wait_closed()


# --- times of a link that carries 1 MB/s, in pieces of 10 kB ---------------------------------------------------------


async def test_bytes_that_cross_when_the_trace_begins_cross_at_its_beginning() -> None:
    """Not once the new trace has come as far as the old one was."""
    times = [5.0]
    link = ShapedLink(Link(Trace.steps([(10, 1e6)])), ("127.0.0.1", 1), clock=lambda: times[0])
    times[0] = 8.0
    crossing = asyncio.create_task(link._cross(10_000, 1.0))
    await asyncio.sleep(0)
    link.begin()
    times[0] = 8.02
    assert await asyncio.wait_for(crossing, 60) == pytest.approx(8.01)


@pytest.mark.parametrize(
    ("now_s", "waited_s", "crossed_s"),
    [
        (0.06, 0.0, 0.02),  # more bytes lay there: the link was busy all the time, however late this program is
        (0.06, 0.002, 0.02),  # an ack had to go round
        (0.06, 0.04, 0.065),  # idle; what comes now counts from 5 ms ago
        (0.5, 0.002, 0.41),  # stopped for half a second: it makes up for 0.1 s
        (0.012, 0.04, 0.02),  # ahead of time
    ],
)
def test_bytes_that_are_late(now_s: float, waited_s: float, crossed_s: float) -> None:
    times = [0.0]
    link = ShapedLink(Link(Trace.steps([(10, 1e6)])), ("127.0.0.1", 1), clock=lambda: times[0])
    assert link._crossed_s(10_000, 0.0) == pytest.approx(0.01)
    times[0] = now_s
    assert link._crossed_s(10_000, waited_s) == pytest.approx(crossed_s)


async def test_waiting_for_a_processor_is_not_waiting_for_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    async def waited_s() -> float:
        ours, theirs = socket.socketpair()
        with ours, theirs:
            ours.setblocking(False)
            asyncio.get_running_loop().call_later(0.02, theirs.send, b"late")
            waited, piece = await shaped._piece(ours)
        assert piece == b"late"
        return waited

    monkeypatch.setattr(shaped, "_starved_s", lambda: 0.0)
    assert await waited_s() > 0.01
    stops = itertools.count()
    monkeypatch.setattr(shaped, "_starved_s", lambda: 100.0 * next(stops))
    assert await waited_s() == pytest.approx(1e-6)
