"""The model: the bounded buffer against a list, the link against exact fractions, and V's rules (Eq. 3-6)."""

import math

import naive
import numpy as np
import pytest
from cases import VALUES, trace, traces
from hypothesis import given
from hypothesis import strategies as st
from refusal_cases import refuse, refused

from bufgym.jit import records
from bufgym.model import link, qoi
from bufgym.model.buffer import MESSAGE, evict, push, row_width
from bufgym.model.link import FOREVER, KnotStore, Link, position_at, segment, time_of

pytestmark = pytest.mark.kernels


@given(st.integers(1, 6), st.lists(st.one_of(st.none(), st.integers(-1, 5)), max_size=80))
def test_the_buffer_agrees_with_a_list(L, actions):
    """None: push (evicting the head when full); -1: the socket takes the head; k: evict slot k."""
    slots = records((2, row_width(L)), MESSAGE)
    first, queue, sent, pushed = 1, [], 0, 0
    for action in actions:
        if action is None:
            if len(queue) == L:
                first = evict(slots, 1, first, L, 0)
                queue.pop(0)
            pushed += 1
            arrival = records(1, MESSAGE)
            arrival["seq"] = pushed
            first = push(slots, 1, first, len(queue), arrival[0])
            queue.append(pushed)
        elif action == -1 and queue:
            first, sent = first + 1, queue.pop(0)
        elif 0 <= action < len(queue):
            first = evict(slots, 1, first, len(queue), action)
            queue.pop(action)
        # The message taken last stands before the head, and the neighbouring row is untouched.
        assert slots["seq"][1, first - 1 : first + len(queue)].tolist() == [sent, *queue]
    assert (slots["seq"][0] == 0).all()


# 1000 bytes in the first 10 ms, nothing for 10 ms, then 3000 bytes in 10 ms: 0.1, 0 and 0.3 bytes a microsecond.
KNOTS = [(0, 0), (10_000, 1_000), (20_000, 1_000), (30_000, 4_000)]


def carrying(knots, after):
    store = KnotStore()
    store.place(trace([(0, 0), (7, 9)], "stop"), 0)  # so that this trace does not begin at knot 0
    first, last, code, *_ = store.place(trace(knots, after), 1)
    where = (store.us, store.bytes, first, last, code, first)
    return lambda t: position_at(*where, t)[0], lambda position: time_of(*where, position)[0]


@given(traces(), st.integers(0, 400_000), st.integers(1, 60_000))
def test_agrees_with_fractions(case, t_us, position):
    knots, after = case
    carried, first_time = carrying(knots, after)
    reference = naive.Link(knots, after)
    assert carried(t_us) == int(reference.bytes_by(t_us))
    at = reference.first_time(position)
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


def test_traces_are_stored_once():
    store, a, b = KnotStore(), trace(KNOTS, "loop"), trace([(0, 0), (5, 5)], "hold")
    assert store.place(a, 0).tolist() == [0, 3, 0, 0, 0]
    assert store.place(b, 1).tolist() == [4, 5, 1, 4, 4]
    assert store.place(a, 1).tolist() == [0, 3, 0, 0, 0]
    assert store.place(b, 0).tolist() == [4, 5, 1, 4, 4]
    assert store.us[:6].tolist() == [0, 10_000, 20_000, 30_000, 0, 5]


def test_traces_that_nobody_follows_make_room(monkeypatch):
    """Room for 8 knots: a new trace for each episode takes the place of one that was left, never of one followed."""
    monkeypatch.setattr(link, "KEPT_KNOTS", 8)
    store, a = KnotStore(), trace(KNOTS, "loop")
    store.place(a, 0)
    for k in range(1, 100):
        first, last, *_ = store.place(trace([(0, 0), (5, k)], "hold"), 1)
        assert store.us[first : last + 1].tolist() == [0, 5] and store.bytes[last] == k
    assert store.us[:4].tolist() == [0, 10_000, 20_000, 30_000] and store.place(a, 1).tolist()[:3] == [0, 3, 0]
    assert len(store.us) == 8
    # Longer ones, each a knot more than the last: the one before is no room for it, but all that were left are.
    for count in range(5, 200):
        store.place(trace([(k, k) for k in range(count)], "hold"), 1)
    assert len(store.us) <= 2 * (4 + 200)


@pytest.mark.parametrize("name", ["offset_us", "propagation_us"])
def test_errors(name):
    refuse(f"{name} = -1: must be a whole number from 0 to", Link, trace(KNOTS, "loop"), **{name: -1})


def huge_traces(rng: np.random.Generator) -> list[tuple[int, int]]:
    """Knots whose times and bytes are of any size below 2^62, as are the products in each segment."""
    knots = [(0, 0)]
    for _ in range(rng.integers(1, 6)):
        us = int(rng.integers(1, 2 ** int(rng.integers(1, 60))))
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
        carried, first_time = carrying(knots, after)
        reference = naive.Link(knots, after)
        for _ in range(10):
            t_us, position = (int(rng.integers(1, 2 ** int(rng.integers(1, 62)))) for _ in range(2))
            exact, at = int(reference.bytes_by(t_us)), reference.first_time(position)
            if exact < 2**62:
                assert carried(t_us) == exact
                checked += 1
            if at is None or at < FOREVER:
                assert first_time(position) == (FOREVER if at is None else at)
                checked += 1
    assert checked > 3_000


def test_information_by_hand():
    assert qoi.exponential(0.5).information([0, 1, 3, 3]) == 1 + 1 / 2 + 3 / 4  # the last is the same view again
    assert qoi.saturating(4).information([0, 1, 10]) == 1 + 1 / 4 + 1


@given(VALUES, st.lists(st.integers(0, 40), max_size=20))
def test_information_agrees_with_reference(v, steps):
    x = (np.cumsum(steps) / 8).tolist()
    assert v.information(x) == naive.information(v, x)


@given(st.floats(0.05, 0.99), st.floats(0.1, 30), st.floats(0, 50))
def test_kinds_agree_with_references(base, distance, d):
    assert qoi.exponential(base)(d) == pytest.approx(naive.exponential(base)(d), abs=1e-15)
    assert qoi.exponential(base)(d) == pytest.approx(1 - base**d, abs=1e-12)
    assert qoi.saturating(distance)(d) == naive.saturating(distance)(d)


@given(st.lists(st.integers(1, 20), min_size=1, max_size=6), st.floats(0, 200))
def test_table_is_numpy_interp(rises, d):
    # Rises that fall, over widths that do not: concave.
    rises = sorted(rises, reverse=True)
    distances = np.cumsum([0, *sorted(range(1, len(rises) + 1))])
    levels = np.cumsum([0, *rises]) / sum(rises)
    v = qoi.tabulated(distances, levels)
    assert v(d) == pytest.approx(np.interp(d, distances, levels), abs=1e-14)
    for at, level in zip(distances, levels, strict=True):
        assert v(at) == pytest.approx(level, abs=1e-15)


@given(VALUES, st.floats(0, 50), st.floats(0, 50))
def test_merging_loss(v, a, b):
    loss = qoi.merging_loss(v.array, a, v(a), b, v(b))
    assert loss == pytest.approx(v(a) + v(b) - v(a + b), abs=1e-12)
    assert loss >= -1e-12  # V is concave: a message between two others is never worth less than nothing


@given(VALUES, st.floats(0, 50), st.floats(0, 50), st.floats(0, 1))
def test_every_v_keeps_the_rules(v, a, b, share):
    assert v(0) == 0
    assert v(min(a, b)) <= v(max(a, b)) <= 1
    assert v(share * a + (1 - share) * b) >= share * v(a) + (1 - share) * v(b) - 1e-12


test_v_that_is_refused = refused(
    (lambda: qoi.tabulated([0, 1, 2], [0, 0.2, 0.8]), r"faster after d = 1, but must be concave \(Eq. 6\)"),
    (lambda: qoi.tabulated([0, 1, 2], [0, 0.5, 0.4]), r"falls from d = 1 on, but must not decrease \(Eq. 5\)"),
    (lambda: qoi.tabulated([0, 1], [0.1, 0.5]), r"V\(0\) = 0.1, but V\(0\) must be 0 \(Eq. 3\)"),
    (lambda: qoi.tabulated([0, 1, 2], [0, 0.9, 1.01]), r"reaches 1.01, but must not exceed 1 \(Eq. 4\)"),
    (lambda: qoi.tabulated([0, 1], [0, math.nan]), "must be a finite number"),
    (lambda: qoi.tabulated([0, math.inf], [0, 1]), "must be a finite number"),
    (lambda: qoi.tabulated([0, 1], [0, 0]), "0 everywhere"),
    (lambda: qoi.tabulated([1, 2], [0, 1]), "must begin at 0 and increase"),
    (lambda: qoi.tabulated([0, 1, 1], [0, 0.5, 1]), "must begin at 0 and increase"),
    (lambda: qoi.tabulated([0], [0]), "two equal lists"),
    (lambda: qoi.tabulated([0, 1, 2], [0, 1]), "two equal lists"),
    *((lambda b=b: qoi.exponential(b), "must lie strictly between 0 and 1") for b in (0, 1, -0.5, math.nan)),
    *((lambda d=d: qoi.saturating(d), "must be a number > 0") for d in (0, -1, math.nan, math.inf)),
    *((lambda d=d: qoi.exponential()(d), "must be a number >= 0") for d in (-1, math.nan)),
    (lambda: qoi.parse("linear:2"), "unknown kind 'linear'; known: exponential, saturating"),
    (lambda: qoi.parse(""), "unknown kind ''"),
    (lambda: qoi.parse("exponential:fast"), "'fast' is not a number"),
    (lambda: qoi.parse("saturating"), "'' is not a number"),
    (lambda: qoi.parse("exponential:2"), "base = 2.0: must lie strictly between 0 and 1"),
)


def test_parse():
    made = [qoi.parse(text) for text in ("exponential:0.7", "exponential", "saturating:4")]
    assert made == [qoi.exponential(0.7), qoi.exponential(0.618), qoi.saturating(4)]
