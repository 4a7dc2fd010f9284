"""The sender by hand; its byte limit B, under which a policy is asked again until the newcomer fits.

``test_topics_reference`` and ``test_policy_registry`` hold it beside its reference model.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from cases import same, trace, watched
from refusal_cases import refused

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.scenario import Episode, messages
from bufgym.sim import Senders, run
from bufgym.sim.metrics import ages_s, outcome, received

kernels = pytest.mark.kernels
V = qoi.exponential(0.5)
MS = 1_000


def line(times_ms, *, capacity=2, sizes=1_000):
    """A sender on a link of 1 MB/s, so that a message of 1000 bytes takes 1 ms."""
    arrivals = messages(np.array(times_ms, np.int64) * MS, np.asarray(sizes, np.int64))
    senders = Senders(1, capacity, V, max_messages=len(arrivals))
    senders.load(0, Episode(arrivals, Link(trace([(0, 0), (1_000 * MS, 1_000_000)], "loop"))))
    return senders


@kernels
def test_what_the_policy_sees():
    policy, views = watched(lambda buffer, arrival: buffer._replace(slots=buffer.slots["seq"].tolist()))
    line([0, 0, 4, 4], sizes=[8_000, 500, 700, 1], capacity=3).run(policy)
    last = views[3]
    assert last.slots == [1, 2]
    assert (last.capacity, last.backlog_bytes, last.dequeued, last.dequeued_x, last.busy) == (3, 1_200, 1, 0.0, 1)
    # Message 0 has had 4 of its 8 ms; the arrival before this one came at 4 ms with x = 2.
    assert (last.left_bytes, last.left_fraction, last.stalled_us) == (4_000, 0.5, 4 * MS)
    assert (last.previous_us, last.previous_x, last.departures) == (4 * MS, 2.0, 0)
    assert (views[0].busy, views[0].left_bytes, views[1].departures) == (0, 0, 1)


@kernels
def test_running_means_by_hand():
    # Arrivals at 0, 8, 10 and 10 ms. The first gap, 8 ms, is the period; then 8 + (2 - 8) / 8, 7.25 + (0 - 7.25) / 8.
    # Message 0 is dequeued before 1, then 1 before 2, and none before 3; each weighs a sixteenth in the service ratio.
    # An eighth of the way to each newcomer's bytes: 1000, + 7000 / 8, - 1874 / 8, - 1639.75 / 8.
    policy, views = watched(lambda buffer, _: (buffer.period_us / MS, buffer.service_ratio, buffer.arrival_bytes))
    line([0, 8, 10, 10], sizes=[1_000, 8_000, 1, 1], capacity=3).run(policy)
    ratio = 1 / 16 + (1 - 1 / 16) / 16
    assert [view[:2] for view in views] == [(0, 0), (8, 1 / 16), (7.25, ratio), (7.25 * 7 / 8, ratio * 15 / 16)]
    assert [view[2] for view in views] == [1_000, 1_875, 1_640.75, 1_435.78125]


def every_second(buffer, memory):
    memory[0] += 1
    return memory[0] % 2 == 0


@kernels
def test_peak_backlog():
    # 0 is in transmission. 1 and 2 wait: 5000 bytes, the most of all, as 3 (500) takes the place of 1 (2000).
    senders = line([0, 0, 0, 0], sizes=[1_000, 2_000, 3_000, 500])
    senders.run(policies.get("drop-oldest"))
    assert outcome(senders, 0).peak_backlog_bytes == 5_000
    # At 1 ms 1 is dropped at the head and 2 is taken. So 3, which comes at 2 ms, waits alone: no more than 5000 yet.
    senders = line([0, 0, 0, 2], sizes=[1_000, 2_000, 3_000, 4_000])
    changes = {"name": "test-head", "on_dequeue": every_second, "memory": {"heads": 0.0}}
    senders.run(replace(policies.get("drop-oldest"), **changes))
    assert outcome(senders, 0).peak_backlog_bytes == 5_000
    assert senders.batch.senders[0]["backlog_bytes"] == 0


SMALL = {"capacity": 2, "v": V, "max_messages": 3}
test_errors = refused(
    (lambda: Senders(1, **SMALL | {"capacity": 0}), "capacity = 0: L must be a whole number from 1"),
    (lambda: Senders(1, **SMALL | {"capacity": 2.0}), "capacity = 2.0"),
    (lambda: Senders(1, **SMALL | {"capacity": True}), "capacity = True"),
    (lambda: Senders(1, **SMALL | {"max_bytes": 0}), "max_bytes = 0: B must be"),
    (
        lambda: Senders(1, **SMALL | {"decide_at": "departure"}),
        "decide_at = 'departure': must be 'arrival' or 'overflow'",
    ),
    (lambda: run(policies.get("afr"), [], 2, V), "no episode to run"),
)


RANKED = [p for p in map(policies.get, policies.names(for_topics=False)) if p.ranked and not p.weights]


# steady has as many sites as L says.
@pytest.mark.parametrize("policy", [p for p in RANKED if p.name != "steady"], ids=lambda p: p.name)
def test_with_equal_sizes_it_is_a_limit_of_messages(policy):
    rng = np.random.default_rng(5)
    arrivals = messages(np.arange(300) * 33_333, 1_000, np.cumsum(rng.random(300) ** 4))
    knots = [(0, 0), (1_000_000, 20_000), (4_000_000, 20_000), (6_000_000, 90_000), (10_000_000, 190_000)]
    episode = Episode(arrivals, Link(trace(knots, "hold"))).with_uniforms(rng)
    for k in (1, 4):
        by_bytes = run(policy, [episode], 8, V, max_bytes=k * 1_000)
        assert outcome(by_bytes, 0).invalid == 0
        assert same(by_bytes, run(policy, [episode], k, V))


# What a run was worth, worked by hand.

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
