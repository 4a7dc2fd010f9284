"""What a run was worth, worked by hand."""

import math

import numpy as np
import pytest
from cases import trace

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.scenario import Episode, messages
from bufgym.sim import run
from bufgym.sim.metrics import ages_s, outcome, received

S = 1_000_000


def us(*seconds):
    return np.rint(np.array(seconds) * S).astype(np.int64)


def test_ages():
    # Taken at 0, 1, 2 s and received at 1, 3, 3.5 s. From 1 to 3 s the age grows from 1 to 3 s (mean 2, for 2 s), from
    # 3 to 3.5 s from 2 to 2.5 s (mean 2.25, for 0.5 s): (4 + 1.125) / 2.5. Peaks 3 and 2.5.
    assert ages_s(us(1, 3, 3.5), us(0, 1, 2)) == pytest.approx((2.05, 2.75, 3.0))


def test_an_old_message_lowers_no_age():
    # The message taken at 1 s comes after that of 2 s: from 3 to 4 s the age goes on from 1 to 2 s. One peak, 3 s.
    assert ages_s(us(1, 3, 4), us(0, 2, 1)) == pytest.approx(((4 + 1.5) / 3, 3.0, 3.0))


def test_ages_of_too_little():
    assert all(math.isnan(a) for a in ages_s(us(1), us(0)))
    assert all(math.isnan(a) for a in ages_s(us(), us()))
    # Both at one instant: no time passes, the age is what it is.
    assert ages_s(us(5, 5), us(1, 2)) == (4.0, 4.0, 4.0)


def test_outcome():
    """1 message a second; 0 goes out, 1 and 2 wait, 3 evicts 1: 0, 2, 3 cross at 1, 2, 3 s and arrive 0.1 s later."""
    arrivals = messages(us(0, 0.5, 0.6, 0.7), 1_000, np.array([0.0, 1.0, 2.0, 4.0]))
    link = Link(trace([(0, 0), (S, 1_000)], "loop"), propagation_us=S // 10)
    senders = run(policies.get("drop-oldest"), [Episode(arrivals, link)], 2, qoi.saturating(8))
    got, result = received(senders, 0), outcome(senders, 0)
    assert (got["seq"].tolist(), got["x"].tolist()) == ([0, 2, 3], [0, 2, 4])
    assert (result.arrived, result.delivered, result.dropped) == (4, 3, 1)
    assert (result.in_transmission, result.buffered, result.invalid) == (0, 0, 0)
    assert result.qoi == 1 + 2 / 8 + 2 / 8
    assert result.longest_gap == 2
    assert result.longest_gap_s == 0.6
    # 1 - 0, 2 - 0.6, 3 - 0.7 s; the 95th percentile lies 0.9 of the way from the second to the third.
    assert result.mean_sojourn_s == pytest.approx((1 + 1.4 + 2.3) / 3)
    assert result.p95_sojourn_s == pytest.approx(1.4 + 0.9 * 0.9)
    # 1.1 to 2.1 s: age 1.1 to 2.1; 2.1 to 3.1 s: age 1.5 to 2.5.
    assert (result.mean_age_s, result.peak_age_s, result.max_age_s) == pytest.approx((1.8, 2.3, 2.5))


def test_nothing_received():
    link = Link(trace([(0, 0), (S, 0)], "stop"))
    result = outcome(run(policies.get("afr"), [Episode(messages(us(0, 1), 5), link)], 2, qoi.exponential()), 0)
    assert (result.qoi, result.delivered, result.in_transmission, result.buffered) == (0, 0, 1, 1)
    assert result.longest_gap == result.longest_gap_s == 0
    assert math.isnan(result.mean_sojourn_s) and math.isnan(result.mean_age_s)
