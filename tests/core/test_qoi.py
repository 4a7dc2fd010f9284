"""Quantity of Information: V's rules (Eq. 3-6), its three kinds, and H."""

from __future__ import annotations

import math

import naive
import numpy as np
import pytest
from cases import VALUES
from hypothesis import given
from hypothesis import strategies as st

from bufgym.errors import BufgymError
from bufgym.model import qoi

pytestmark = pytest.mark.kernels


def test_by_hand():
    # Frames 0, 1, 3 with V = 1 - 0.5^d: 1 + 1/2 + 3/4.
    assert qoi.exponential(0.5).information([0, 1, 3]) == 2.25
    # Turning on the spot, 4 frames to a new view: 1 + 1/4 + 1 (a gap of 9 shows no more than one of 4).
    assert qoi.saturating(4).information([0, 1, 10]) == 2.25
    v = qoi.exponential()
    assert v.information([]) == 0
    assert v.information([7.5]) == 1
    assert v.information([3, 3]) == 1  # the same view again


@given(VALUES, st.lists(st.integers(0, 40), max_size=20))
def test_information_agrees_with_twin(v, steps):
    x = (np.cumsum(steps) / 8).tolist()
    assert v.information(x) == naive.information(v, x)


@given(st.floats(0.05, 0.99), st.floats(0.1, 30), st.floats(0, 50))
def test_kinds_agree_with_twins(base, distance, d):
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


def test_straight_and_then_flat():
    assert [qoi.straight(v.array) for v in (qoi.exponential(0.5), qoi.saturating(3))] == [False, True]
    assert qoi.straight(qoi.tabulated([0, 4], [0, 1]).array)
    assert qoi.straight(qoi.tabulated([0, 4, 9], [0, 0.5, 0.5]).array)
    assert not qoi.straight(qoi.tabulated([0, 4, 9], [0, 0.5, 0.6]).array)


@pytest.mark.parametrize(
    ("build", "rule"),
    [
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
    ],
)
def test_what_is_refused(build, rule):
    with pytest.raises(BufgymError, match=rule):
        build()


def test_parse():
    made = [qoi.parse(text) for text in ("exponential:0.7", "exponential", "saturating:4")]
    assert made == [qoi.exponential(0.7), qoi.exponential(0.618), qoi.saturating(4)]
