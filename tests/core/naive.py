"""Slow, obvious twins of the compiled kernels: lists, dictionaries and fractions, written from the model's description.

Nothing here calls a kernel, and nothing here is clever. A twin and its kernel must agree exactly.
"""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

from naive_policies import policy
from naive_queues import ACCEPT, REJECT, Policy

__all__ = ["ACCEPT", "REJECT", "Link", "Policy", "Sender", "exponential", "information", "policy", "saturating"]


# --- quantity of information -----------------------------------------------------------------------------------------


def exponential(base):
    return lambda d: 1 - math.exp(d * math.log(base))


def saturating(distance):
    return lambda d: min(1.0, d / distance)


def information(v, x):
    """H = 1 + sum of V(x_i - x_{i-1}); nothing received, nothing known."""
    if not x:
        return 0.0
    return 1 + sum(v(b - a) for a, b in itertools.pairwise(x))


# --- the link --------------------------------------------------------------------------------------------------------


class Link:
    """Capacity over time as a list of (us, bytes) knots, with exact fractions between them."""

    def __init__(self, knots, after, offset_us=0):
        self.knots, self.after, self.offset_us = knots, after, offset_us

    def pieces(self):
        """(start us, bytes then, end us, bytes then) of every straight piece, for as long as the link carries any."""
        pieces = [(*a, *b) for a, b in itertools.pairwise(self.knots)]
        yield from pieces
        duration, total = self.knots[-1]
        if self.after == "loop":
            for lap in itertools.count(1):
                for t0, b0, t1, b1 in pieces:
                    yield lap * duration + t0, lap * total + b0, lap * duration + t1, lap * total + b1
        if self.after == "hold":
            t0, b0, t1, b1 = pieces[-1]
            for _ in itertools.count() if b1 > b0 else ():
                t0, b0, t1, b1 = t1, b1, 2 * t1 - t0, 2 * b1 - b0
                yield t0, b0, t1, b1

    def bytes_by(self, t_us):
        """C at the sender's time t, a fraction."""
        t = t_us + self.offset_us
        for t0, b0, t1, b1 in self.pieces():
            if t <= t1:
                return b0 + Fraction((b1 - b0) * (t - t0), t1 - t0)
        return Fraction(b1)  # it has stopped for good

    def first_time(self, position):
        """The first whole microsecond at which that many bytes could have crossed; None for never."""
        for t0, b0, t1, b1 in self.pieces():
            if position <= b1:
                exact = t0 + Fraction((position - b0) * (t1 - t0), b1 - b0)
                return math.ceil(exact) - self.offset_us
        return None


# --- the sender ------------------------------------------------------------------------------------------------------


class Sender:
    """One sender, event by event. Messages are dictionaries: seq, us, bytes, x, luck."""

    def __init__(self, link, policy, capacity, max_bytes=None, decide_at="arrival"):
        self.link, self.policy, self.capacity = link, policy, capacity
        policy.sender = self
        self.max_bytes = math.inf if max_bytes is None else max_bytes
        self.decide_at = decide_at
        self.queue = []
        self.sending = None  # the message in transmission, outside the buffer
        self.finish = None  # when its last byte will have crossed; None: never
        self.position = 0  # bytes of the link used up when it has
        self.last_dequeued = None
        self.previous = None  # the arrival before this one, kept or not
        self.measured = []  # at each arrival, what the robot's own socket tells of its link
        self.periods = []  # running mean of the time between arrivals, us, of which the newest weighs 1/8
        self.dequeued, self.transmitted, self.dropped, self.order = {}, {}, {}, []
        self.sizes = {}  # of those dequeued
        self.rejected = self.evicted = self.invalid = 0
        self.evictions = 0  # of those, for the arrival at hand

    def run(self, messages, first_decision=0, last_decision=math.inf):
        for message in messages:
            # (1) all that the link finishes up to and including now leaves, and successors start
            self.advance(message["us"])
            if self.previous is not None:
                period = message["us"] - self.previous["us"]
                mean = self.periods[-1] if self.periods else float(period)
                self.periods.append(mean + (period - mean) / 8)
            self.measured.append(self.measure(message["us"]))
            # (2) the policy decides
            fits = self.fits(self.queue, message)
            asked = first_decision <= message["seq"] <= last_decision
            if asked and self.decide_at == "overflow":
                asked = not fits
            self.settle(message, asked)
            # (3) an idle socket takes the head at once
            if self.sending is None and self.queue:
                self.take_head(message["us"], math.floor(self.link.bytes_by(message["us"])))
        # the buffer drains
        self.advance(math.inf)
        return self

    def advance(self, until):
        while self.sending is not None and self.finish is not None and self.finish <= until:
            done, now = self.sending["seq"], self.finish
            self.transmitted[done] = now
            self.order.append(done)
            self.sending = None
            if self.queue:
                self.take_head(now, self.position)

    def take_head(self, now, position):
        """The socket takes the head; its first byte follows byte ``position`` of the link."""
        for _ in range(self.policy.unwanted(list(self.queue), now)):
            self.drop(self.queue.pop(0), now)
            self.evicted += 1
        if not self.queue:
            return
        self.sending = self.last_dequeued = self.queue.pop(0)
        self.position = position + self.sending["bytes"]
        self.finish = self.link.first_time(self.position)
        self.dequeued[self.sending["seq"]] = now
        self.sizes[self.sending["seq"]] = self.sending["bytes"]
        self.policy.departed(self.queue)

    def left_bytes(self, now):
        """Bytes of the message in transmission that have not crossed by now."""
        if self.sending is None:
            return 0
        size = self.sending["bytes"]
        if self.dequeued[self.sending["seq"]] == now:
            return size
        return min(size, max(0, self.position - math.floor(self.link.bytes_by(now))))

    def measure(self, now):
        """What left the socket and in how much time, in all and since the last arrival, and means of their ratio.

        The newest of a mean over w weighs what it took / (what it took + w); at first w is all that came before.
        """
        if self.previous is None:
            return {"sent": 0, "us": 0, "drained": 0, "drained_us": 0} | dict.fromkeys(("short", "medium", "long"), 0.0)
        last = self.measured[-1]
        begun = [m for m in self.dequeued if m in self.transmitted or m == self.sending["seq"]]
        sent = sum(self.sizes[m] for m in begun) - self.left_bytes(now)
        us = sum(self.transmitted.get(m, now) - self.dequeued[m] for m in begun)
        made = {"sent": sent, "us": us, "drained": sent - last["sent"], "drained_us": us - last["us"]}
        for name, w in (("short", 100_000), ("medium", 500_000), ("long", 2_000_000)):
            mean = last[name]
            if made["drained_us"] > 0:
                weight = made["drained_us"] + min(w, last["us"])
                mean += (made["drained"] - mean * made["drained_us"]) / weight
            made[name] = mean
        return made

    def fits(self, queue, message):
        enough_bytes = sum(m["bytes"] for m in queue) + message["bytes"] <= self.max_bytes
        return len(queue) < self.capacity and enough_bytes

    def settle(self, message, asked):
        """The policy is asked until the arrival fits or is rejected; what is larger than B is dropped unasked."""
        previous = self.previous if self.previous is not None else message
        last_dequeued = self.last_dequeued if self.last_dequeued is not None else previous
        self.evictions, settled = 0, False
        while not settled:
            decision = ACCEPT
            if message["bytes"] > self.max_bytes:
                decision = REJECT
            elif asked:
                decision = self.policy.decide(list(self.queue), message, self.capacity, last_dequeued, previous)
            settled = self.carry_out(decision, message)
        self.previous = message

    def carry_out(self, decision, message):
        """Whether the arrival has been enqueued or dropped; if not, its policy is asked again."""
        if decision == REJECT:
            self.drop(message)
            self.rejected += 1
            return True
        if decision != ACCEPT and 0 <= decision < len(self.queue):
            self.drop(self.queue.pop(decision), message["us"])
            self.evicted += 1
            self.evictions += 1
            if not self.fits(self.queue, message):
                return False
            self.queue.append(message)
            return True
        # What a queue does: accept where there is room, reject where there is none.
        fits = self.fits(self.queue, message)
        if decision != ACCEPT or not fits:
            self.invalid += 1
        if fits:
            self.queue.append(message)
        else:
            self.drop(message)
            self.rejected += 1
        return True

    def drop(self, message, now=None):
        self.dropped[message["seq"]] = message["us"] if now is None else now
