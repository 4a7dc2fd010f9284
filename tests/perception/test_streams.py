"""Frames sent over a link: sizes, the fade at another place, and what arrives."""

from __future__ import annotations

import numpy as np
import pytest
from view_cases import Wall

from bufgym.perception import streams
from bufgym.traces import Trace

TRACE = Trace.steps([(1, 100.0), (1, 50.0), (2, 10.0)], name="falling")


def test_sizes_lie_between_those_that_were_encoded() -> None:
    """Frame k has 1000 (k + 1) bytes; every second one is encoded, and the last."""
    assert streams.sizes(Wall([0.0] * 4), every=2).tolist() == [1000, 2000, 3000, 4000]


def test_the_first_frames_are_a_recording() -> None:
    part = streams.first(Wall([0, 1, 2]), 2)
    assert len(part) == 2 and part.poses[1, 0, 3] == 1 and part.depth(1)[0, 0] == 2
    assert part.size_bytes(1) == 2000
    whole = Wall([0, 1])
    assert streams.first(whole, 5) is whole


@pytest.mark.parametrize(("offset_us", "first_second"), [(0, 100), (1_000_000, 50), (2_000_000, 100)])
def test_an_offset_moves_the_fade_and_changes_nothing_else(offset_us: int, first_second: int) -> None:
    """Two seconds carry 150 bytes wherever they begin; what comes after them is the two seconds again."""
    link = streams.fading(2_000_000, TRACE, offset_us)
    carried = np.diff([link.carried_at(t) for t in (0, 1_000_000, 2_000_000, 3_000_000)])
    assert carried[0] == first_second and carried[:2].sum() == 150 and carried[2] == carried[0]


def test_a_stream_longer_than_the_trace_meets_it_again() -> None:
    link = streams.fading(9_000_000, TRACE)
    assert link.carried_at(4_000_000) == 170 and link.carried_at(8_000_000) == 340


def test_what_arrives_over_a_slow_link() -> None:
    """Frames of 10 bytes each 1/30 s; the link carries one while three come, the queue holds one."""
    wall = Wall([0.1 * k for k in range(9)])
    fast, slow = (Trace.constant(rate, 10.0, name="link") for rate in (1e6, 100.0))
    size = np.full(9, 10, np.int64)
    everything = streams.received("drop-oldest", streams.episode(wall, size, streams.fading(300_000, fast)), 1)
    assert everything == tuple(range(9))
    # In transmission: 0 until 0.1 s, as 3 comes; 3 replaces 2 before the next is taken, and so on.
    some = streams.received("drop-oldest", streams.episode(wall, size, streams.fading(10_000_000, slow)), 1)
    assert some[0] == 0 and some[-1] == 8 and len(some) < 6


def test_random_draws_by_the_seed() -> None:
    wall, size = Wall([0.1 * k for k in range(60)]), np.full(60, 10, np.int64)
    link = streams.fading(10_000_000, Trace.constant(60.0, 10.0, name="link"))
    kept = [streams.received("random", streams.episode(wall, size, link, seed), 5) for seed in (0, 0, 1)]
    assert kept[0] == kept[1] != kept[2]
