"""What a robot remembers of its link and its camera, as numbers that are brought up to date at every arrival.

All of it is measured on board: bytes that left the own socket, the own clock, the own odometry. The fields that show it
are ``bufgym.model.observe.past``. An update takes one division, and one logarithm a second.

The link's rate *now* is measured over at least ``LEAST_US`` in which the socket had bytes to send. It has *changed*
where it and the rate at the last change differ by more than the factor ``CHANGE``. It *stalls* where it is under
``STALLS_BELOW`` of the mean of the whole run; a *stall* is at least ``STALL_US`` of that.
"""

import math

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel

Past = NDArray[np.float64]
"""float64[PAST]: one sender's memory of its link and its camera."""

BEGAN_US, BEGAN_X, SENT_BYTES, SENDING_US, RATE, CHANGED_US, TOP = range(7)
STALLED_US, STALL_LAST_US, STALL_BEFORE_US, STALL_ENDED_US, N_STALLS = range(7, 12)
SAMPLED_US, SAMPLED_BYTES, SAMPLED_SENDING_US, LEVEL, MEAN, VARIANCE, COVARIANCE, STOPPED_US = range(12, 20)
PAST = 20
"""Entries: when and where (x) the stream began; bytes sent, and time sending, when the rate was last measured; the rate
at the last change, bytes/us, and its time; the largest rate over 0.5 s, bytes/s; how long the link stalls now; the last
two stalls, the last one's end and how many there were; time, bytes and sending time of the last sample of the log rate;
that sample, 0 for none, mean, variance, covariance with the sample before; the camera's last stop, -1 for none."""

LEAST_US = 5_000.0  # Shortest time over which the rate is measured, us
CHANGE = 1.1
STALLS_BELOW, STALL_US = 0.03, 250_000.0
KNOWN_US = 1e6  # Sending time before which nothing is a stall, us
TOP_US = 200_000.0  # Sending time before which no rate is a top rate, us
SAMPLE_US = 1e6  # Time between samples of the log rate, us
SAMPLE_WEIGHT = 0.08  # of the newest sample: about the last 12
LEAST_RATE = 0.01  # Samples are at least this part of the mean rate
STOPS_BELOW = 0.05  # The camera stands where its pace is at most this part of its mean


@kernel
def begin_past(past: Past, now_us: int, x: float) -> None:
    """Note the first arrival; all entries are 0 before it."""
    past[BEGAN_US], past[BEGAN_X], past[STOPPED_US] = now_us, x, -1.0


@kernel
def remember_past(
    past: Past,
    now_us: int,
    gap_us: int,
    x: float,
    step_x: float,
    sent_bytes: int,
    sending_us: int,
    rate_bytes_per_s: float,
) -> None:
    """Note a later arrival: time and motion since the one before, all that was sent so far, the rate over 0.5 s."""
    sent, sending, now = float(sent_bytes), float(sending_us), float(now_us)
    span = sending - past[SENDING_US]
    if span >= LEAST_US:
        note_rate(past, now, (sent - past[SENT_BYTES]) / span, span, sent, sending)
        past[SENT_BYTES], past[SENDING_US] = sent, sending
        if sending > TOP_US:
            past[TOP] = max(past[TOP], rate_bytes_per_s)
        if now - past[SAMPLED_US] >= SAMPLE_US and sent > 0:
            note_level(past, now, sent, sending)
    if step_x * (now - past[BEGAN_US]) <= STOPS_BELOW * (x - past[BEGAN_X]) * gap_us and gap_us > 0:
        past[STOPPED_US] = now


@kernel
def note_rate(past: Past, now: float, rate: float, span: float, sent: float, sending: float) -> None:
    """Note the rate of the last ``span`` of sending, bytes/us and us: has it changed, does the link stall?"""
    if rate > CHANGE * past[RATE] or past[RATE] > CHANGE * rate:
        past[RATE], past[CHANGED_US] = rate, now
    if sending > KNOWN_US and rate * sending < STALLS_BELOW * sent:
        past[STALLED_US] += span
    elif past[STALLED_US] > 0:
        if past[STALLED_US] >= STALL_US:
            past[STALL_BEFORE_US], past[STALL_LAST_US] = past[STALL_LAST_US], past[STALLED_US]
            past[STALL_ENDED_US] = now
            past[N_STALLS] += 1
        past[STALLED_US] = 0.0


@kernel
def note_level(past: Past, now: float, sent: float, sending: float) -> None:
    """Take a sample: the logarithm of the mean rate since the last one, bytes/s, in which the socket had bytes."""
    rate = (sent - past[SAMPLED_BYTES]) / (sending - past[SAMPLED_SENDING_US])
    level = math.log(max(1e6 * max(rate, LEAST_RATE * sent / sending), 2.0))
    if past[LEVEL] == 0:
        past[MEAN] = level
    off = level - past[MEAN]
    past[MEAN] += SAMPLE_WEIGHT * off
    off = level - past[MEAN]
    past[VARIANCE] += SAMPLE_WEIGHT * (off * off - past[VARIANCE])
    if past[LEVEL] > 0:
        past[COVARIANCE] += SAMPLE_WEIGHT * (off * (past[LEVEL] - past[MEAN]) - past[COVARIANCE])
    past[LEVEL], past[SAMPLED_US], past[SAMPLED_BYTES], past[SAMPLED_SENDING_US] = level, now, sent, sending
