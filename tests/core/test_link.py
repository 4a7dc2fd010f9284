"""The link: when bytes cross, worked by hand and against exact fractions."""

from __future__ import annotations

import naive
import numpy as np
import pytest
from cases import trace, traces
from hypothesis import given
from hypothesis import strategies as st

from bufgym.errors import BufgymError
from bufgym.model import link
from bufgym.model.link import FOREVER, Knots, Link, position_at, segment, time_of

# 1000 bytes in the first 10 ms, nothing for 10 ms, then 3000 bytes in 10 ms: 0.1, 0 and 0.3 bytes a microsecond.
pytestmark = pytest.mark.kernels
KNOTS = [(0, 0), (10_000, 1_000), (20_000, 1_000), (30_000, 4_000)]


def kernels(knots, after):
    store = Knots()
    store.place(trace([(0, 0), (7, 9)], "stop"), 0)  # so that this trace does not begin at knot 0
    first, last, code = store.place(trace(knots, after), 1)
    where = (store.us, store.bytes, first, last, code, first)
    return lambda t: position_at(*where, t)[0], lambda position: time_of(*where, position)[0]


def test_inside_the_trace():
    carried, first_time = kernels(KNOTS, "stop")
    assert carried(0) == 0
    assert carried(15) == 1  # 1.5 bytes, rounded down
    assert carried(10_000) == carried(19_999) == 1_000  # the outage
    assert carried(25_000) == 2_500
    assert first_time(1) == 10  # 0.1 bytes a microsecond
    assert first_time(1_000) == 10_000  # the last byte before the outage
    assert first_time(1_001) == 20_004  # 1 byte at 0.3 a microsecond: 3.33 us, so the 4th
    assert first_time(4_000) == 30_000


def test_after_the_end():
    carried, first_time = kernels(KNOTS, "loop")
    assert carried(30_000 + 15_000) == 4_000 + 1_000
    assert first_time(8_000) == 60_000  # the very end of the second lap
    assert first_time(8_001) == 60_010
    carried, first_time = kernels(KNOTS, "hold")
    assert carried(40_000) == 4_000 + 3_000
    assert first_time(4_000 + 3_001) == 40_004
    carried, first_time = kernels(KNOTS, "stop")
    assert carried(10**9) == 4_000
    assert first_time(4_001) == FOREVER
    # Holding a rate of 0 carries nothing either.
    assert kernels([*KNOTS, (31_000, 4_000)], "hold")[1](4_001) == FOREVER


@given(traces(), st.integers(0, 400_000), st.integers(1, 60_000))
def test_agrees_with_fractions(case, t_us, position):
    knots, after = case
    carried, first_time = kernels(knots, after)
    twin = naive.Link(knots, after)
    assert carried(t_us) == int(twin.bytes_by(t_us))
    at = twin.first_time(position)
    assert first_time(position) == (FOREVER if at is None else at)
    if at is not None:
        # The first microsecond at which that many bytes could have crossed, and no later one.
        assert carried(at) >= position > (carried(at - 1) if at > 0 else 0)


@given(traces(), st.integers(0, 5), st.integers(0, 10**6))
def test_a_hint_changes_nothing(case, hint, point):
    us = np.array([t for t, _ in case[0]])
    last = len(us) - 1
    point %= us[-1]
    assert segment(us, 0, last, min(hint, last - 1), point) == segment(us, 0, last, 0, point)
    k = segment(us, 0, last, 0, point)
    assert us[k] <= point < us[k + 1]


def test_nothing_is_lost_to_rounding():
    # 3 bytes in 7 us: messages of 1 byte end at ceil(7/3), ceil(14/3), 7, ... and after 3 million of them at 7 s.
    _, first_time = kernels([(0, 0), (7, 3)], "loop")
    assert [first_time(k) for k in range(1, 7)] == [3, 5, 7, 10, 12, 14]
    assert first_time(3_000_000) == 7_000_000


def test_traces_are_stored_once():
    store, a, b = Knots(), trace(KNOTS, "loop"), trace([(0, 0), (5, 5)], "hold")
    assert store.place(a, 0) == (0, 3, 0)
    assert store.place(b, 1) == (4, 5, 1)
    assert store.place(a, 1) == (0, 3, 0)
    assert store.place(b, 0) == (4, 5, 1)
    assert store.us[:6].tolist() == [0, 10_000, 20_000, 30_000, 0, 5]


def test_traces_that_nobody_follows_make_room(monkeypatch):
    """Room for 8 knots: a new trace for each episode takes the place of one that was left, never of one followed."""
    monkeypatch.setattr(link, "KEPT_KNOTS", 8)
    store, a = Knots(), trace(KNOTS, "loop")
    store.place(a, 0)
    for k in range(1, 100):
        new = trace([(0, 0), (5, k)], "hold")
        first, last, _ = store.place(new, 1)
        assert store.us[first : last + 1].tolist() == [0, 5] and store.bytes[last] == k
    assert store.us[:4].tolist() == [0, 10_000, 20_000, 30_000] and store.place(a, 1) == (0, 3, 0)
    assert len(store.us) == 8
    # Longer ones, each a knot more than the last: the one before is no room for it, but all that were left are.
    for count in range(5, 200):
        store.place(trace([(k, k) for k in range(count)], "hold"), 1)
    assert len(store.us) <= 2 * (4 + 200)


@pytest.mark.parametrize("name", ["offset_us", "propagation_us"])
def test_errors(name):
    with pytest.raises(BufgymError, match=f"{name} = -1: must be a whole number from 0 to"):
        Link(trace(KNOTS, "loop"), **{name: -1})


def huge_traces(rng: np.random.Generator) -> list[tuple[int, int]]:
    """Knots whose times and bytes are of any size below 2^62, as are the products in each segment."""
    knots = [(0, 0)]
    for _ in range(rng.integers(1, 6)):
        bits = int(rng.integers(1, 60))
        us = int(rng.integers(1, 2**bits))
        most = min((2**62 - 1) // us, 2**62 - 1 - knots[-1][1])
        carried = int(rng.integers(0, most, endpoint=True)) >> int(rng.integers(0, 40))
        if knots[-1][0] + us >= 2**62:
            break
        knots.append((knots[-1][0] + us, knots[-1][1] + carried))
    return knots if len(knots) > 1 and knots[-1][1] > 0 else [(0, 0), (3, 7)]


@pytest.mark.parametrize("after", ["loop", "hold", "stop"])
def test_exact_wherever_the_result_is_below_2_to_the_62(after):
    """Random traces, times and positions of every size, against fractions: no product wraps around."""
    rng, checked = np.random.default_rng(7), 0
    for _ in range(300):
        knots = huge_traces(rng)
        carried, first_time = kernels(knots, after)
        twin = naive.Link(knots, after)
        for _ in range(10):
            t_us, position = (int(rng.integers(1, 2 ** int(rng.integers(1, 62)))) for _ in range(2))
            exact, at = int(twin.bytes_by(t_us)), twin.first_time(position)
            if exact < 2**62:
                assert carried(t_us) == exact
                checked += 1
            if at is None or at < FOREVER:
                assert first_time(position) == (FOREVER if at is None else at)
                checked += 1
    assert checked > 3_000
