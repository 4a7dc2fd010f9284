"""Rules that look at gaps: towards the gap that link and room can carry, and thinned on a steady link."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from cases import VALUES, cases, newcomer, queue_of, same
from gap_cases import Seen, approached, fits, least_gap, level, spared
from hypothesis import given

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.buffer import ACCEPT, REJECT
from bufgym.model.link import Link
from bufgym.policies import Policy, target_gap
from bufgym.policies.target_gap import PACE, PARAMETERS, PERIOD, RATE, SEEN_US, SENT_US, SQUARE, last_chance, needless
from bufgym.policies.thinning import send_us, spare, steady
from bufgym.scenario import Episode, messages, suites
from bufgym.scenario.numbered import by_trace, draw
from bufgym.sim import run
from bufgym.sim.metrics import outcome, received
from bufgym.traces import Trace

POLICY = policies.get("target-gap")
NUMBERS = np.array(list(PARAMETERS.values()))
kernels = pytest.mark.kernels


def frames_at_30_hz(*frames, sent=0, now=8, per_frame=1.0, **known):
    """Frames of 1000 bytes at 30 Hz are queued, frame ``sent`` is in the socket, frame ``now`` arrives; x is
    ``per_frame`` times the number of the frame. At 7500 bytes/s the link sends one frame every four."""
    buffer = queue_of(len(frames), 8)
    for name, scale in (("arrival_us", 33_333), ("x", per_frame), ("seq", 1)):
        buffer.slots[name] = scale * np.array(frames)
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
def test_near_the_end_of_the_stream_the_target_is_what_comes_until_then():
    # In 2 s come 60 frames, and the link sends 15: with three waiting one in 60 / 20. In 0.2 s 6 come, 1.5 are sent.
    def left(us):
        return target(*fast(2, 4, 6, remaining_us=us), remembered())

    assert left(2_000_000) == pytest.approx(2 * 60 / 20, rel=1e-3)
    assert left(200_000) == pytest.approx(2 * 6 / 6.5, rel=1e-3)
    assert left(5_000_000) == left(60_000_000) == target(*fast(2, 4, 6), remembered())  # farther than the horizon
    assert left(0) == left(5_000_000)  # past an end that was told wrong
    # Just before it: what has room goes in, and a full queue keeps to the link's gap.
    assert 0 < left(1) < 1e-4
    assert target(*fast(0, 1, 2, 3, 4, 5, 6, 7, remaining_us=1), remembered()) == pytest.approx(2 * 4.0, rel=1e-3)


@kernels
@pytest.mark.parametrize(
    "change",
    [{"capacity": 3}, {"max_bytes": 3999}, {"dequeued_arrival_us": 8 * 33_333}],
    ids=["short queue", "room for three", "no time"],
)
def test_where_the_future_is_not_to_be_told_there_is_no_target(change):
    assert target(*fast(2, 4, **change), remembered()) == 0


@kernels
def test_a_large_newcomer_takes_no_place_from_those_that_wait():
    # Under B of 9000 bytes eight of 1000 wait; with a newcomer of 28000 the mean is 4000, and two would fit.
    buffer, arrival = fast(0, 1, 2, 3, 4, 5, 6, 7, capacity=20, max_bytes=9000)
    arrival["size_bytes"] = 28_000
    g = target(buffer, arrival, remembered())
    assert g == pytest.approx(2 * 4.0 * 4, rel=1e-3)  # as the link sends messages four times as large


@kernels
def test_a_stream_must_have_run_for_as_long_as_the_queue_takes_to_be_sent():
    # L = 8 at 7.5 a second: 1.07 s.
    assert target(*fast(2, 4), remembered(seen_us=1.06e6)) == 0
    # A quarter of that, 0.267 s, where the robot knows when it ends.
    assert target(*fast(2, 4, remaining_us=10**7), remembered(seen_us=0.26e6)) == 0
    assert target(*fast(2, 4, remaining_us=10**7), remembered(seen_us=0.27e6)) > 0
    assert target(*fast(2, 4), remembered(seen_us=1.07e6)) > 0
    assert target(*fast(2, 4), remembered(rate=0.0)) == 0
    # Bursts are not followed.
    assert target(*fast(2, 4), remembered(square=1.4 * 33_333.0**2)) > 0
    assert target(*fast(2, 4), remembered(square=1.6 * 33_333.0**2)) == 0
    assert target(*fast(2, 4), remembered(pace=0.0)) == 0


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


@kernels
def test_a_full_queue_drops_the_smallest_gap_older_ones_rather():
    # Each leaves 4 frames, the head's count 3.34; the newcomer leaves 4 where it is frame 19, 2 where it is 17.
    frames = (2, 4, 6, 8, 10, 12, 14, 16)
    assert approach(*fast(*frames, now=19), 1.0) == 0
    assert approach(*fast(*frames, now=17), 1.0) == REJECT


@kernels
def test_an_idle_or_empty_socket_takes_what_comes():
    assert approach(*fast(2, 4, 6, busy=0), 99.0) == ACCEPT
    assert approach(*fast(), 99.0) == ACCEPT


@kernels
def test_long_means_are_kept():
    memory = np.zeros(6)
    buffer, arrival = fast(2, drained_bytes=500, drained_us=20_000)
    remember(buffer, arrival, memory)
    assert memory.tolist() == [500 / 20_000, 20_000, 2 / 33_333, 33_333, 33_333, 33_333**2]
    remember(buffer._replace(evictions=1), arrival, memory)  # the same arrival once more
    assert memory[SEEN_US] == 33_333
    remember(buffer._replace(drained_bytes=0, drained_us=10_000), arrival, memory)
    assert memory[RATE] == pytest.approx(500 / 30_000) and memory[PACE] == pytest.approx(4 / 66_666)
    assert memory[PERIOD] == pytest.approx(33_333) and memory[SQUARE] == pytest.approx(33_333**2)
    long = np.array([1.0, 60e6, 1.0, 60e6, 1.0, 1.0])  # windows of 20 s and 15 s, however long it has run
    remember(buffer._replace(drained_bytes=0, drained_us=20_000_000), arrival, long)
    assert long[RATE] == pytest.approx(0.5)
    assert long[PERIOD] == pytest.approx(1 + 33_332 / 32)  # the newest weighs 1/32
    assert long[PACE] == pytest.approx((15e6 + 2) / (15e6 + 33_333))


@kernels
def test_where_v_is_straight_the_message_between_adds_nothing():
    # In x, 0 was sent, 4, 10 and 16 wait, 20 comes: without 4 a gap of 10 is left, without 10 of 12, without 16 of 10.
    buffer, arrival = fast(2, 5, 8, now=10)
    for v, k in ((qoi.saturating(10), 0), (qoi.saturating(9.9), -1), (qoi.exponential(0.9), -1)):
        assert needless(buffer._replace(v=v.array), arrival) == k
    bend = qoi.tabulated([0, 10, 20], [0, 0.7, 1]).array
    assert needless(buffer._replace(v=bend), arrival) == 0
    assert needless(buffer._replace(v=bend, busy=0), arrival) == -1  # an idle link takes what there is


@kernels
def test_the_head_of_a_short_queue_gets_a_last_chance():
    # L = 4, one waits: f = 1/4. The link sends one in four now, as in the mean: S = M = 4 arrivals. The head may leave
    # 1 + 1.09 / 4 + (.76 - .92 / 4) 4 + .076 / 4 x 4 = 3.47 arrivals, 6.94 in x.
    short = {"capacity": 4, "left_bytes": 254, "short_rate_bytes_per_s": 7500.0}

    def goes(*frames, **known):
        return last_chance(*fast(*frames, **short | known), remembered(), NUMBERS)

    assert goes(1, now=3) and not goes(1, now=4)  # 3 and 4 arrivals
    assert not goes(1, now=3, left_bytes=256)  # 1.02 arrivals of 250 bytes have not left yet
    assert not goes(1, now=3, capacity=6) and not goes(1, now=3, medium_rate_bytes_per_s=7500.0, drained_us=1)
    # At twice the rate S = 2: 1 + .27 + 1.06 + .08 = 2.41.
    assert goes(1, now=2, short_rate_bytes_per_s=15000.0) and not goes(1, now=3, short_rate_bytes_per_s=15000.0)


def twin():
    """A policy that decides alike, of what it has seen."""
    seen = Seen()

    def on_arrival(buffer, arrival, memory):
        seen.remember(buffer, arrival)
        extra = seen.needless(buffer, arrival)
        if extra is not None:
            return extra
        if seen.last_chance(buffer, arrival):
            return 0
        g = seen.target(buffer, arrival)
        if g is not None and not level(buffer):
            return approached(buffer, arrival, g)
        victim = least_gap(buffer, arrival)
        return ACCEPT if fits(buffer, arrival) and (seen.bursty or not spared(buffer, arrival, victim)) else victim

    return Policy("twin", on_arrival, reads_rate=True)


@kernels
@given(cases(max_messages=25), VALUES)
def test_decides_as_its_twin(case, v):
    assert same(case.run(POLICY, v), case.run(twin(), v))
    told = replace(case.episode, ends_us=int(case.episode.arrivals["arrival_us"][-1]) * 3 // 4)
    for other in (replace(case, decide_at="overflow"), replace(case, episode=told)):
        assert same(other.run(POLICY, v), other.run(twin(), v))


def test_over_fading_links_less_is_lost_than_by_the_smallest_gap_alone():
    """The validation links of ``generated-v1``, 900 kB by time, L = 15: less than three quarters of AFR's regret."""
    scenario = suites.get("generated-v1").settings("validation")["time-900kB"].scenario
    episodes = [draw(link, seed=1) for _, link in by_trace(scenario)]

    def total(name):
        return float(run(policies.get(name), episodes, 15, scenario.value).batch.senders["delivered_gain"].sum())

    assert total("afr") < total("min-motion-gap") < total("target-gap")


V = qoi.exponential(0.618)


def waiting(*frames, rate_bytes_per_s=7500.0, **known):
    rates = {"medium_rate_bytes_per_s": rate_bytes_per_s, "long_rate_bytes_per_s": rate_bytes_per_s / 2}
    return frames_at_30_hz(*frames, **rates | known)


@kernels
def test_the_fastest_rate_of_late_says_how_long_a_message_takes():
    assert send_us(*waiting(2, 5)) == pytest.approx(1e6 * 1000 / 7500)
    assert send_us(*waiting(2, 5, rate_bytes_per_s=0.0)) == 0


@kernels
def test_what_goes_leaves_no_gap_longer_than_the_link_sends():
    # Sent: 0; queued: 2, 5, 7; frame 8 comes. Without 2 a gap of 5 frames is left, without 5 one of 5, without 7 of 3.
    # The link sends one frame every four.
    spares = [spare(*waiting(2, 5, 7), victim) for victim in (0, 1, 2, REJECT)]
    assert spares == [False, False, True, True]  # without 8: from 7 to 9, which is expected
    slower = [spare(*waiting(2, 5, 7, rate_bytes_per_s=5900.0), victim) for victim in (0, 1)]
    assert slower == [True, True]  # one in 5.08


@kernels
def test_the_room_that_is_left_is_to_be_filled_in_a_minute():
    # One frame in four is sent, 450 in a minute; with 26 places more 4 x 450 / 476 = 3.78.
    assert not spare(*waiting(1, 4, 8, now=12, capacity=29), 0)  # leaves a gap of 4
    assert spare(*waiting(1, 4, 8, now=12, capacity=3), 0)


@kernels
def test_or_by_the_end_of_the_stream():
    # 15 frames are sent in 2 s; with 3 places more 4 x 15 / 18 = 3.33, with 1 more 3.75.
    assert spare(*waiting(2, 5, 7, capacity=6, remaining_us=2_000_000), REJECT)  # leaves a gap of 2
    assert not spare(*waiting(1, 4, 8, now=12, capacity=4, remaining_us=2_000_000), 0)  # leaves a gap of 4
    assert spare(*waiting(1, 4, 8, now=12, capacity=3, remaining_us=2_000_000), 0)  # no room: one frame in four
    assert not spare(*waiting(2, 5, 7, remaining_us=1), REJECT)


@kernels
def test_the_link_never_waits_for_what_was_spared():
    assert not spare(*waiting(5, 7), REJECT)  # two wait: three are wanted
    assert not spare(*waiting(2, 5, 7, busy=0), 2)
    assert not spare(*waiting(2, 5, 7, rate_bytes_per_s=0.0), 2)
    assert not spare(*waiting(2, 5, 7, dequeued_arrival_us=8 * 33_333), 2)  # all at one time: no pace


@kernels
def test_a_long_queue_on_a_slow_link_is_kept_for_the_end_of_the_stream():
    assert spare(*waiting(2, 5, 7, capacity=29), 2)  # 29 x 1000 / 7500 = 3.87 s
    assert not spare(*waiting(2, 5, 7, capacity=31), 2)  # 4.13 s: over SOON_US


@kernels
def test_a_link_is_steady_while_its_rates_agree():
    buffer = queue_of(0, 8)._replace(drained_us=1000)

    def is_steady(short, medium, long, **known):
        rates = {"short_rate_bytes_per_s": short, "medium_rate_bytes_per_s": medium, "long_rate_bytes_per_s": long}
        return steady(buffer._replace(**rates, **known))

    assert is_steady(1e6, 1e6, 1e6) and is_steady(1.02e6, 0.99e6, 1e6)
    assert not is_steady(1.03e6, 1e6, 1e6) and not is_steady(1e6, 0.98e6, 1e6)
    assert not is_steady(0.0, 0.0, 0.0) and not is_steady(1e6, 1e6, 1e6, drained_us=0)


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


def test_a_link_that_keeps_up_loses_nothing():
    assert outcome(run(policies.get("target-gap"), [episode(1.5)], 20, V), 0).delivered == 600
