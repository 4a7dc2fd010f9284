"""A queue with room is thinned to what a steady link can send, and no further."""

from __future__ import annotations

import frame_cases
import numpy as np
import pytest
from cases import queue_of

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.buffer import REJECT
from bufgym.model.link import Link
from bufgym.policies.gaps import MESSAGES, MOTION
from bufgym.policies.thinning import send_us, spare, steady
from bufgym.scenario import Episode, messages
from bufgym.sim import run
from bufgym.sim.metrics import outcome, received
from bufgym.traces import Trace

kernels = pytest.mark.kernels
V = qoi.exponential(0.618)


def waiting(*frames, rate_bytes_per_s=7500.0, **known):
    rates = {"medium_rate_bytes_per_s": rate_bytes_per_s, "long_rate_bytes_per_s": rate_bytes_per_s / 2}
    return frame_cases.waiting(*frames, **rates | known)


@kernels
def test_the_fastest_rate_of_late_says_how_long_a_message_takes():
    assert send_us(*waiting(2, 5)) == pytest.approx(1e6 * 1000 / 7500)
    assert send_us(*waiting(2, 5, rate_bytes_per_s=0.0)) == 0


@kernels
@pytest.mark.parametrize("measured_in", [MOTION, MESSAGES])
def test_what_goes_leaves_no_gap_longer_than_the_link_sends(measured_in):
    # Sent: 0; queued: 2, 5, 7; frame 8 comes. Without 2 a gap of 5 frames is left, without 5 one of 5, without 7 of 3.
    # The link sends one frame every four.
    spares = [spare(*waiting(2, 5, 7), victim, measured_in) for victim in (0, 1, 2, REJECT)]
    assert spares == [False, False, True, True]  # without 8: from 7 to 9, which is expected
    slower = [spare(*waiting(2, 5, 7, rate_bytes_per_s=5900.0), victim, measured_in) for victim in (0, 1)]
    assert slower == [True, True]  # one in 5.08


@kernels
def test_the_room_that_is_left_is_to_be_filled_in_a_minute():
    # One frame in four is sent, 450 in a minute; with 26 places more 4 x 450 / 476 = 3.78.
    assert not spare(*waiting(1, 4, 8, now=12, capacity=29), 0, MESSAGES)  # leaves a gap of 4
    assert spare(*waiting(1, 4, 8, now=12, capacity=3), 0, MESSAGES)


@kernels
def test_the_link_never_waits_for_what_was_spared():
    assert not spare(*waiting(5, 7), REJECT, MOTION)  # two wait: three are wanted
    assert not spare(*waiting(2, 5, 7, busy=0), 2, MOTION)
    assert not spare(*waiting(2, 5, 7, rate_bytes_per_s=0.0), 2, MOTION)
    assert not spare(*waiting(2, 5, 7, dequeued_arrival_us=8 * 33_333), 2, MOTION)  # all at one time: no pace


@kernels
def test_a_long_queue_on_a_slow_link_is_kept_for_the_end_of_the_stream():
    assert spare(*waiting(2, 5, 7, capacity=29), 2, MOTION)  # 29 x 1000 / 7500 = 3.87 s
    assert not spare(*waiting(2, 5, 7, capacity=31), 2, MOTION)  # 4.13 s: over SOON_US


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
        senders = run(policies.get(name), [one], 20, V)
        x = received(senders, 0)["x"]
        streams.append(x[(x > 0.05 * frames) & (x < 0.9 * frames)])
    thinned, full = streams
    assert np.diff(thinned).max() <= np.floor(1 / share) + 1  # the queue fills meanwhile, in a minute and more
    assert np.diff(thinned).std() < 0.8 * np.diff(full).std()


def test_a_link_that_keeps_up_loses_nothing():
    assert outcome(run(policies.get("target-gap"), [episode(1.5)], 20, V), 0).delivered == 600
