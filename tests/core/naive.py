"""Slow, obvious reference models of the kernels: lists, dictionaries and fractions, from the model's description.

Nothing here calls a kernel, and nothing here is clever. A reference model and its kernel must agree exactly.
"""

import itertools
import math
from fractions import Fraction

import naive_sender
from naive_policies import policy
from naive_queues import ACCEPT, REJECT, Policy

__all__ = ["ACCEPT", "REJECT", "Link", "Policy", "Sender", "exponential", "information", "policy", "saturating"]


def exponential(base):
    return lambda d: 1 - math.exp(d * math.log(base))


def saturating(distance):
    return lambda d: min(1.0, d / distance)


def information(v, x):
    """H = 1 + sum of V(x_i - x_{i-1}); nothing received, nothing known."""
    if not x:
        return 0.0
    return 1 + sum(v(b - a) for a, b in itertools.pairwise(x))


class Link:
    """Capacity over time as a list of (us, bytes) knots, with exact fractions between them."""

    def __init__(self, knots, after, offset_us=0):
        self.knots, self.after, self.offset_us = knots, after, offset_us
        (from_us, from_bytes), (self.us, self.bytes) = knots[-2:]
        self.rate = Fraction(self.bytes - from_bytes, self.us - from_us)  # of the last piece

    def bytes_by(self, t_us):
        """C at the sender's time t, a fraction."""
        t = t_us + self.offset_us
        laps, t = divmod(t, self.us) if self.after == "loop" else (0, t)
        for (t0, b0), (t1, b1) in itertools.pairwise(self.knots):
            if t <= t1:
                return laps * self.bytes + b0 + Fraction((b1 - b0) * (t - t0), t1 - t0)
        return self.bytes + (t - self.us) * self.rate * (self.after == "hold")

    def first_time(self, position):
        """The first whole microsecond at which that many bytes could have crossed; None for never."""
        if position > self.bytes and self.after == "hold" and self.rate:
            return self.us + math.ceil((position - self.bytes) / self.rate) - self.offset_us
        laps = max(0, math.ceil(position) - 1) // self.bytes if self.after == "loop" else 0
        position -= laps * self.bytes
        for (t0, b0), (t1, b1) in itertools.pairwise(self.knots):
            if position <= b1:
                within = Fraction(position - b0) * (t1 - t0) / max(1, b1 - b0)
                return laps * self.us + t0 + math.ceil(within) - self.offset_us
        return None


class Sender(naive_sender.Sender):
    """A sender of one queue whose ``policy`` decides; it measures its link as a robot's own socket can."""

    def __init__(self, link, policy, capacity, max_bytes=None, decide_at="arrival"):
        rules = naive_sender.Rules(None)
        super().__init__(link, rules, capacity, max_bytes=max_bytes, decide_at=decide_at, drops_heads=True)
        self.policy, self.ask = policy, self.answer
        policy.sender = self
        self.unwanted = None  # heads still to be dropped before the socket takes one
        self.measured = []  # at each arrival, what the robot's own socket tells of its link
        self.periods = []  # running mean of the time between arrivals, us, of which the newest weighs 1/8

    @property
    def queue(self):
        return self.queues[0]

    @property
    def previous(self):
        """The arrival before the newcomer, kept or not; the newcomer itself where it is the first."""
        return self.arrived[0][-1] if self.arrived[0] else self.newcomer

    @property
    def last_dequeued(self):
        return self.sent[0][-1] if self.sent[0] else self.previous

    def answer(self, event):
        if event == "decision":
            return self.policy.decide(list(self.queue), self.newcomer)
        if event == "dequeue":
            if self.unwanted is None:
                self.unwanted = self.policy.unwanted(list(self.queue), self.now)
            drop, left = self.unwanted > 0, self.unwanted - 1
            self.unwanted = left if drop and len(self.queue) > 1 else None
            return drop
        if event == "departure":
            self.policy.departed(self.queue)
        return None

    def arrive(self, message, asked):
        if self.arrived[0]:
            period = message["us"] - self.arrived[0][-1]["us"]
            mean = self.periods[-1] if self.periods else float(period)
            self.periods.append(mean + (period - mean) / 8)
        self.measured.append(self.measure())
        super().arrive(message, asked)

    def measure(self):
        """What left the socket and in how much time, in all and since the last arrival, and means of their ratio.

        The newest of a mean over w weighs what it took / (what it took + w); at first w is all that came before.
        """
        if not self.measured:
            return dict.fromkeys(("sent", "us", "drained", "drained_us"), 0) | dict.fromkeys(RATES_US, 0.0)
        last = self.measured[-1]
        sent = sum(m["bytes"] for m in self.sent[0]) - self.left_bytes()
        us = sum(self.transmitted.get(m["seq"], self.now) - self.dequeued[m["seq"]] for m in self.sent[0])
        made = {"sent": sent, "us": us, "drained": sent - last["sent"], "drained_us": us - last["us"]}
        for name, w in RATES_US.items():
            mean = last[name]
            if made["drained_us"] > 0:
                mean += (made["drained"] - mean * made["drained_us"]) / (made["drained_us"] + min(w, last["us"]))
            made[name] = mean
        return made


RATES_US = {"short": 100_000, "medium": 500_000, "long": 2_000_000}
"""The time that each mean of the link's rate looks back over."""
