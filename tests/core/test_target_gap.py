"""Rules that look at gaps: towards the gap that link and room can carry, and thinned on a steady link."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from cases import VALUES, cases, newcomer, queue_of, same
from gap_cases import Seen, approached, faded, fits, least_gap, level, running_mean, spared
from hypothesis import given, settings
from hypothesis import strategies as st

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.buffer import ACCEPT, REJECT
from bufgym.model.link import FOREVER, Link
from bufgym.policies import Policy, target_gap
from bufgym.policies.target_gap import (
    PACE,
    PARAMETERS,
    PERIOD,
    RATE,
    SEEN_US,
    SENT_US,
    SQUARE,
    falls_behind,
    last_chance,
    needless,
)
from bufgym.policies.thinning import spare, steady
from bufgym.scenario import Episode, messages, suites
from bufgym.scenario.numbered import by_trace, draw
from bufgym.sim import run
from bufgym.sim.metrics import outcome, received
from bufgym.traces import Trace

POLICY = policies.get("target-gap")
NUMBERS = np.array(list(PARAMETERS.values()))
V = qoi.exponential(0.618)
RULES = ("target-gap", "min-motion-gap", "drop-oldest")
kernels = pytest.mark.kernels


def frames_at_30_hz(*frames, sent=0, now=8, per_frame=1.0, **known):
    """Frames of 1000 bytes at 30 Hz are queued, frame ``sent`` is in the socket, frame ``now`` arrives; x is
    ``per_frame`` times the number of the frame. At 7500 bytes/s the link sends one frame every four."""
    buffer = queue_of(len(frames), 8)
    for name, scale in (("arrival_us", 33_333), ("x", per_frame), ("seq", 1)):
        buffer.slots[name] = scale * np.array(frames)
    buffer.slots["size_bytes"] = 1000
    arrival = newcomer()
    arrival["arrival_us"], arrival["x"] = 33_333 * now, per_frame * now
    arrival["seq"], arrival["size_bytes"] = now, 1000
    seen = {"busy": 1, "left_bytes": 1000, "backlog_bytes": 1000 * len(frames), "period_us": 33_333.0}
    seen |= {"dequeued_arrival_us": 33_333 * sent, "dequeued_x": per_frame * sent, "dequeued_seq": sent}
    seen |= {"previous_us": 33_333 * (now - 1), "previous_x": per_frame * (now - 1)}
    return buffer._replace(**seen | known), arrival


def fast(*frames, **known):
    """x is twice the number of the frame, and the stream has run for 10 s. The rate over 0.5 s is not to be used."""
    rates = {f"{span}_rate_bytes_per_s": rate for span, rate in (("short", 7500.0), ("medium", 77.0), ("long", 7500.0))}
    return frames_at_30_hz(*frames, per_frame=2.0, **rates | known)


def remembered(rate=7500e-6, pace=2 / 33_333, seen_us=10e6, square=33_333.0**2):
    memory = np.zeros(6)
    memory[[RATE, SENT_US, PACE, SEEN_US, PERIOD, SQUARE]] = rate, seen_us, pace, seen_us, 33_333, square
    return memory


target, approach, remember = (
    partial(rule, numbers=NUMBERS) for rule in (target_gap.target, target_gap.approach, target_gap.remember)
)


@kernels
def test_the_target_is_what_comes_divided_by_what_the_link_and_the_room_carry():
    # In 5 s come 150 frames; the link sends 37.5, and three waiting leave room for 5: one in 150 / 42.5 = 3.53.
    assert target(*fast(2, 4, 6), remembered()) == pytest.approx(2 * 3.53, rel=1e-3)
    full = fast(0, 1, 2, 3, 4, 5, 6, 7)
    assert target(*full, remembered()) == pytest.approx(2 * 4.0, rel=1e-3)  # no room: as the link sends
    # Half the rate is that over 20 s, a quarter each that over 0.1 s and 2 s: 7500 x (0.5 + 0.25 + 0).
    slow, arrival = fast(0, 1, 2, 3, 4, 5, 6, 7, short_rate_bytes_per_s=0.0)
    assert target(slow, arrival, remembered()) == pytest.approx(2 * 4 / 0.75, rel=1e-3)
    # Motion: 0.6 of what has come since the message dequeued last, 0.4 of the mean over 15 s.
    assert target(*full, remembered(pace=0.5 / 33_333)) == pytest.approx(4 * (0.6 * 2 + 0.4 * 0.5), rel=1e-3)


@kernels
def test_the_head_goes_when_its_turn_comes_and_the_next_lies_nearer_to_the_target():
    near = {"left_bytes": 374}  # 1.5 arrivals of 250 bytes: before it is decided for good
    assert approach(*fast(3, 5, 8, now=12, **near), 9.0) == 0  # gaps of 6 or 10: 10 is nearer to 9
    assert approach(*fast(3, 5, 8, now=12, **near), 7.9) == ACCEPT
    assert approach(*fast(3, 5, 8, now=12, left_bytes=376), 9.0) == ACCEPT  # not its turn yet


@kernels
def test_with_room_goes_what_leaves_a_gap_no_longer_than_the_target():
    # In x, 0 was sent, 4, 8 and 12 wait and 16 comes: each leaves 8, the newcomer 6, as 18 is expected after it.
    # That of the head counts 8 x 0.835 = 6.68.
    assert approach(*fast(2, 4, 6), 6.0) == REJECT
    assert approach(*fast(2, 4, 6), 5.9) == ACCEPT
    # With 14 behind 12 that leaves 4 (16 less 12), as does the newcomer: the older of both.
    assert approach(*fast(2, 4, 6, 7), 4.0) == 3
    assert approach(*fast(4, 5, 6, now=12, sent=3), 4.0) == 0


RATES = (0.0, 80.0, 900.0, 7_500.0, 30_000.0)
"""Bytes/s, where 30 messages of 1000 bytes come a second: some seconds for each message, or links that keep up."""


@st.composite
def moments(draw):
    """(buffer, newcomer, memory, what the reference has seen): queues short and long, links idle, steady and fading."""
    rng, pick = np.random.default_rng(draw(st.integers(0, 2**32))), lambda *choices: draw(st.sampled_from(choices))
    seen, memory, even = Seen(), np.zeros(6), draw(st.booleans())
    for _ in range(draw(st.integers(1, 5))):  # what has come: windows of 20 s and 15 s are passed
        us, bytes_ = int(rng.choice([0, 33_333, 9_000_000])), int(rng.integers(0, 30_000))
        past, arrival = frames_at_30_hz(2, drained_bytes=bytes_, drained_us=us, evictions=int(rng.integers(0, 6)) // 5)
        past = past._replace(previous_us=int(arrival["arrival_us"]) - (33_333 if even else int(rng.integers(0, 10**7))))
        seen.remember(past, arrival)
        remember(past, arrival, memory)
    s, L, mean = draw(st.integers(0, 9)), pick(1, 2, 3, 4, 5, 9, 30), pick(*RATES)
    frames = np.cumsum(rng.integers(1, 4, s + 1))
    known = {"capacity": max(L, s), "max_bytes": pick(10**12, 9_000, 3_999), "busy": pick(0, 1, 1, 1)}
    known |= {"short_rate_bytes_per_s": mean * pick(1.0, 1.015, 1.03, 2.0, 0.3), "long_rate_bytes_per_s": mean}
    known |= {"medium_rate_bytes_per_s": mean * pick(1.0, 0.995, 0.98), "left_bytes": int(rng.integers(1, 1000))}
    known |= {"remaining_us": pick(FOREVER, FOREVER, 2_000_000, 200_000, 1, 0), "drained_us": pick(0, 1000)}
    known |= {"evictions": 0, "v": pick(V, qoi.saturating(9), qoi.tabulated([0, 9, 20], [0, 0.7, 1])).array}
    known |= {"dequeued_arrival_us": 33_333 * pick(0, 0, 0, int(frames[-1]))}
    buffer, arrival = frames_at_30_hz(*frames[:-1], now=int(frames[-1]), per_frame=pick(0.5, 2.0), **known)
    arrival["size_bytes"] = pick(1000, 28_000)
    return buffer, arrival, memory, seen


@kernels
@settings(max_examples=4 * settings().max_examples)
@given(moments())
def test_each_rule_is_its_references_at_any_moment(moment):
    """Windows, horizons and limits beyond those of the short random episodes below."""
    buffer, arrival, memory, seen = moment
    means = [running_mean(seen.sent, 20e6), sum(us for _, us in seen.sent), running_mean(seen.moved, 15e6)]
    assert memory.tolist() == pytest.approx([*means, seen.seen_us, *faded(seen.periods)])
    assert steady(buffer) == level(buffer)
    assert last_chance(buffer, arrival, memory, NUMBERS) == seen.last_chance(buffer, arrival)
    assert falls_behind(buffer, arrival, memory, NUMBERS) == seen.falls_behind(buffer, arrival)
    needless_, g = seen.needless(buffer, arrival), seen.target(buffer, arrival)
    assert needless(buffer, arrival) == (-1 if needless_ is None else needless_)
    assert target(buffer, arrival, memory) == pytest.approx(g or 0.0)
    for near in (0.5, g or 4.0, 9.0):
        assert approach(buffer, arrival, near) == approached(buffer, arrival, near)
    for victim in range(REJECT, len(buffer.slots)):
        assert spare(buffer, arrival, victim) == spared(buffer, arrival, victim)


def reference():
    """A policy that decides alike, of what it has seen."""
    seen = Seen()

    def on_arrival(buffer, arrival, memory):
        seen.remember(buffer, arrival)
        extra = seen.needless(buffer, arrival)
        if extra is not None:
            return extra
        if seen.last_chance(buffer, arrival) or seen.falls_behind(buffer, arrival):
            return 0
        g = seen.target(buffer, arrival)
        if g is not None and not level(buffer):
            return approached(buffer, arrival, g)
        victim = least_gap(buffer, arrival)
        return ACCEPT if fits(buffer, arrival) and (seen.bursty or not spared(buffer, arrival, victim)) else victim

    return Policy("reference model", on_arrival, reads_rate=True)


@kernels
@given(cases(max_messages=25), VALUES)
def test_decides_as_its_reference(case, v):
    assert same(case.run(POLICY, v), case.run(reference(), v))
    with_end = replace(case.episode, ends_us=int(case.episode.arrivals["arrival_us"][-1]) * 3 // 4)
    for other in (replace(case, decide_at="overflow"), replace(case, episode=with_end)):
        assert same(other.run(POLICY, v), other.run(reference(), v))


def test_over_fading_links_less_is_lost_than_by_the_smallest_gap_alone():
    """The validation links of ``generated-v1``, 900 kB by time, L = 15: less than three quarters of AFR's regret."""
    scenario = suites.get("generated-v1").settings("validation")["time-900kB"].scenario
    episodes = [draw(link, seed=1) for _, link in by_trace(scenario)]

    def total(name):
        return float(run(policies.get(name), episodes, 15, scenario.value).batch.senders["delivered_gain"].sum())

    assert total("afr") < total("min-motion-gap") < total("target-gap")


def episode(share, frames=600):
    """Frames of 1000 bytes at 30 Hz over a steady link of this share of them."""
    us = np.array([0, 10_000_000], np.int64)
    link = Link(Trace("steady", us, (us * share * 0.03).astype(np.int64)), 0, 0)
    at = np.arange(frames)
    return Episode(messages(at * 33_333, np.full(frames, 1000), at.astype(float)), link)


@pytest.mark.parametrize("share", [1 / 4.1, 1 / 5.1])
def test_on_a_steady_link_the_server_gets_an_even_stream(share):
    """About as far apart as the link sends, though twenty would find room; what is queued at the end is not counted."""
    frames = 3000
    one = episode(share, frames)
    streams = []
    for name in ("target-gap", "min-motion-gap"):
        x = received(run(policies.get(name), [one], 20, V), 0)["x"]
        streams.append(x[(x > 0.05 * frames) & (x < 0.9 * frames)])
    thinned, full = streams
    assert np.diff(thinned).max() <= np.floor(1 / share) + 1  # the queue fills meanwhile, in a minute and more
    assert np.diff(thinned).std() < 0.8 * np.diff(full).std()


def test_one_place_takes_each_newcomer_until_the_steady_link_is_free():
    """It sends one frame in ten, and what waits in the end. The first one to find room would leave too early."""
    x = received(run(POLICY, [episode(1 / 10)], 1, V), 0)["x"]
    assert x.tolist() == [*range(0, 600, 10), 599]


@pytest.mark.parametrize("capacity", [1, 2, 3])
def test_short_queues_on_a_steady_link_lose_no_more_than_simple_rules(capacity):
    H = {name: outcome(run(policies.get(name), [episode(1 / 10)], capacity, V), 0).qoi for name in RULES}
    assert H["target-gap"] == max(H.values()) > H["min-motion-gap"]


def test_a_link_that_keeps_up_loses_nothing():
    assert outcome(run(policies.get("target-gap"), [episode(1.5)], 20, V), 0).delivered == 600
