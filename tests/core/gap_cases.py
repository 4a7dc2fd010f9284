"""Slow reference models of ``policies.thinning`` and ``target_gap``; gaps in ``x`` (motion) or ``seq`` (messages).

``Seen`` keeps all that it saw and takes its means anew each time.
"""

import itertools

from naive_policies import least

from bufgym.model.link import FOREVER
from bufgym.policies import ACCEPT, REJECT
from bufgym.policies.thinning import SOON_US


def gaps_left(buffer, arrival):
    """The gap that each queued message, and last the newcomer, would leave."""
    come = [buffer.dequeued_x]
    come += [message["x"] for message in buffer.slots]
    come.append(arrival["x"])
    # One more step like the last is expected after the newcomer.
    come.append(arrival["x"] + (arrival["x"] - buffer.previous_x))
    steps = [float(after - before) for before, after in itertools.pairwise(come)]
    return list(map(sum, itertools.pairwise(steps)))


def least_gap(buffer, arrival, discount=0.0):
    """What leaves the smallest gap; slot k of s counts ``discount`` (1 - k / s) less."""
    *queued, newcomer = gaps_left(buffer, arrival)
    gaps = [gap * (1 - discount * (1 - k / len(queued))) for k, gap in enumerate(queued)]
    excess = buffer.backlog_bytes + int(arrival["size_bytes"]) - buffer.max_bytes
    return least(gaps, newcomer, buffer.slots["size_bytes"].tolist(), excess, buffer.evictions > 0)


def fits(buffer, arrival):
    """Whether the newcomer fits as the queue is, by messages and by bytes."""
    return len(buffer.slots) < buffer.capacity and buffer.backlog_bytes + arrival["size_bytes"] <= buffer.max_bytes


def places(buffer, arrival):
    """How many messages of mean size there is room for in all: L, or what B lets in; no fewer than are queued."""
    sizes = [message["size_bytes"] for message in buffer.slots] + [arrival["size_bytes"]]
    return max(len(buffer.slots), min(buffer.capacity, int(buffer.max_bytes / (sum(map(int, sizes)) / len(sizes)))))


def level(buffer):
    """Whether the link is steady: the rates over 0.1 s and 0.5 s are that over 2 s, but for 2 % and 1 %."""
    short, medium, long = (getattr(buffer, f"{span}_rate_bytes_per_s") for span in ("short", "medium", "long"))
    near = abs(short - long) <= 0.02 * long and abs(medium - long) <= 0.01 * long
    return bool(near and long > 0 and buffer.drained_us > 0)


def near(horizon_us, buffer):
    """The horizon, or the rest of the stream if that is less, known, and not over."""
    return min(horizon_us, buffer.remaining_us or horizon_us)


def spared(buffer, arrival, victim):
    """Whether a queue with room can spare ``victim``."""
    s, elapsed_us = len(buffer.slots), arrival["arrival_us"] - buffer.dequeued_arrival_us
    mean_bytes = (buffer.backlog_bytes + arrival["size_bytes"]) / (s + 1)
    rate = max(getattr(buffer, f"{span}_rate_bytes_per_s") for span in ("short", "medium", "long"))
    if s < 3 or not buffer.busy or len(buffer.topics) > 1 or rate == 0 or elapsed_us <= 0:
        return False
    send_us = 1e6 * mean_bytes / rate
    last = buffer.dequeued_x
    left = gaps_left(buffer, arrival)[s if victim == REJECT else victim]
    L = places(buffer, arrival)
    soon = L * send_us <= SOON_US
    T = near(60e6, buffer)
    room_us = T / (T / send_us + L - s)  # a minute's messages, and those for which there is room
    return soon and left * elapsed_us <= float(arrival["x"] - last) * room_us


class Seen:
    """What one policy has seen of one queue."""

    def __init__(self):
        self.sent, self.moved = [], []  # (bytes, us) and (x, us) of each arrival with any time in it
        self.periods = []  # us before each arrival

    def remember(self, buffer, arrival):
        if buffer.evictions:
            return
        if buffer.drained_us > 0:
            self.sent.append((float(buffer.drained_bytes), float(buffer.drained_us)))
        self.periods.append(float(arrival["arrival_us"] - buffer.previous_us))
        if arrival["arrival_us"] > buffer.previous_us:
            step = arrival["x"] - buffer.previous_x
            self.moved.append((float(step), float(arrival["arrival_us"] - buffer.previous_us)))

    @property
    def seen_us(self):
        return sum(us for _, us in self.moved)

    @property
    def bursty(self):
        mean, square = faded(self.periods)
        return square > 1.5 * mean * mean

    def needless(self, buffer, arrival):
        """The queued message whose neighbours lie within the straight part of V, the closest of several; or None."""
        kind, *rest = buffer.v
        reach = 0.0 if kind == 0 else rest[0] if kind == 1 else rest[2]
        left = gaps_left(buffer, arrival)[:-1]
        if not left or not buffer.busy or len(buffer.topics) > 1 or min(left) > reach or reach == 0:
            return None
        return left.index(min(left))

    def last_chance(self, buffer, arrival):
        """Whether the head of a queue of two to five goes before its turn."""
        s, L, rate = len(buffer.slots), places(buffer, arrival), buffer.short_rate_bytes_per_s
        period, mean_rate = buffer.period_us, running_mean(self.sent, 20e6)
        if not 2 <= L <= 5 or s == 0 or not buffer.busy or rate <= 0 or mean_rate <= 0 or len(buffer.topics) > 1:
            return False
        if level(buffer) or self.bursty or not buffer.left_bytes * 1e6 < 1.02 * period * rate:
            return False
        size, f = (buffer.backlog_bytes + arrival["size_bytes"]) / (s + 1), s / L
        S, M = min(1e6 * size / rate, 16 * period), min(size / mean_rate, 16 * period)
        us = (1.0 + 1.09 * f) * period + (0.76 - 0.92 * f) * S + 0.076 * f * M
        return gaps_left(buffer, arrival)[0] <= running_mean(self.moved, 15e6) * us

    def falls_behind(self, buffer, arrival):
        """Whether the head of a queue of one to three goes on a steady link, which sends farther apart."""
        s, L = len(buffer.slots), places(buffer, arrival)
        elapsed_us = float(arrival["arrival_us"] - buffer.dequeued_arrival_us)
        if s == 0 or L > 3 or not buffer.busy or elapsed_us <= 0 or len(buffer.topics) > 1:
            return False
        if not level(buffer) or self.bursty or (L > 1 and not free_soon(buffer)):
            return False
        rate = max(getattr(buffer, f"{span}_rate_bytes_per_s") for span in ("short", "medium", "long"))
        send_us = 1e6 * (buffer.backlog_bytes + arrival["size_bytes"]) / (s + 1) / rate
        return lies_worse(buffer, arrival, float(arrival["x"] - buffer.dequeued_x) * send_us / elapsed_us)

    def target(self, buffer, arrival):
        """g, or None where it cannot be told."""
        L, s = places(buffer, arrival), len(buffer.slots)
        elapsed_us = float(arrival["arrival_us"] - buffer.dequeued_arrival_us)
        rate, pace = running_mean(self.sent, 20e6), running_mean(self.moved, 15e6)
        if L < 4 or len(buffer.topics) > 1 or elapsed_us <= 0 or rate <= 0 or pace <= 0:
            return None
        if self.bursty:
            return None
        recent = (0.25 * buffer.short_rate_bytes_per_s + 0.25 * buffer.long_rate_bytes_per_s) / 1e6
        r = (recent + 0.5 * rate) / ((buffer.backlog_bytes + arrival["size_bytes"]) / (s + 1))
        sooner = 4 if buffer.remaining_us < FOREVER else 1
        if sooner * r * self.seen_us < L or (L <= 5 and self.seen_us < 10e6):
            return None
        m = 0.6 * float(arrival["x"] - buffer.dequeued_x) / elapsed_us + 0.4 * pace
        T = near(5e6, buffer)
        g = m * T / (r * T + L - s)
        return g if g > 0 else None


def faded(periods):
    """Means of the periods and of their squares, of which the newest weighs 1/32; the first that is not 0 all."""
    mean = square = 0.0
    for period in periods:
        weight = 1 / 32 if mean > 0 else 1.0
        mean, square = mean + weight * (period - mean), square + weight * (period * period - square)
    return mean, square


def running_mean(steps, window_us):
    """Of amounts a us, each weighing its time beside all of the past, but no more of that than the window."""
    mean = seen_us = 0.0
    for amount, us in steps:
        mean += (amount - mean * us) / (us + min(window_us, seen_us))
        seen_us += us
    return mean


def free_soon(buffer):
    """Whether the socket is free before 1.5 more arrivals."""
    return buffer.left_bytes * 1e6 < 1.5 * buffer.period_us * buffer.short_rate_bytes_per_s


def lies_worse(buffer, arrival, g):
    """Whether the gap that the head would leave is nearer to ``g`` than the gap before it."""
    return abs(gaps_left(buffer, arrival)[0] - g) < abs(float(buffer.slots[0]["x"] - buffer.dequeued_x) - g)


def approached(buffer, arrival, g):
    """The decision that brings the gaps to ``g``."""
    s = len(buffer.slots)
    room = fits(buffer, arrival)
    if room and (s == 0 or not buffer.busy):
        return ACCEPT
    left = gaps_left(buffer, arrival)
    if s and free_soon(buffer) and lies_worse(buffer, arrival, g):
        return 0
    victim = least_gap(buffer, arrival, discount=0.165)
    if room and left[s if victim == REJECT else victim] > 1.001 * g:
        return ACCEPT
    return victim
