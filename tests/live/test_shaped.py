"""When a shaped link counts as idle, by hand: it carries 1 MB/s, and pieces have 10 kB."""

from __future__ import annotations

import asyncio
import itertools
import socket

import pytest

from bufgym.live import shaped
from bufgym.live.shaped import ShapedLink
from bufgym.model.link import Link
from bufgym.traces import Trace


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


def test_waiting_for_a_processor_is_not_waiting_for_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    async def waited_s() -> float:
        ours, theirs = socket.socketpair()
        with ours, theirs:
            ours.setblocking(False)
            asyncio.get_running_loop().call_later(0.05, theirs.send, b"late")
            waited, piece = await shaped._piece(ours)
        assert piece == b"late"
        return waited

    monkeypatch.setattr(shaped, "_starved_s", lambda: 0.0)
    assert asyncio.run(waited_s()) > 0.04
    stops = itertools.count()
    monkeypatch.setattr(shaped, "_starved_s", lambda: 100.0 * next(stops))
    assert asyncio.run(waited_s()) == pytest.approx(1e-6)
