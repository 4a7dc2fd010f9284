"""Slow, obvious reference model of a sender, of one queue or of several topics: lists, and everything from scratch.

Written from the model's description; it calls no kernel. A list holds each topic's queue, another the messages in
flight. Messages are dictionaries: seq, us, bytes, x, uniform, topic.
"""

import math
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise
from typing import Any, NamedTuple

# What the sender may be told: a slot to evict or to send, or one of these.
REJECT, ACCEPT, HOLD = -1, -2, -1


@dataclass
class Rules:
    """What the operator asks of one topic. Without any, it is the one queue of a plain sender."""

    v: Any
    priority: float = 1.0
    weight: float = 1.0
    period_us: int = 0
    limit: float = math.inf
    no_drop: bool = False
    deadline_us: float = math.inf


class Sent(NamedTuple):
    """A message that the socket has taken, and when its last byte will have crossed (None: never)."""

    message: dict[str, Any]
    due: int | None


SETTINGS = {"max_bytes": None, "decide_at": "arrival", "window": 1, "ack_delay_us": 0, "propagation_us": 0}
SETTINGS |= dict.fromkeys(("schedules", "drops_heads", "limit_at_send", "limit_since_sent", "flush_no_drop"), False)


class Sender:
    """One sender, event by event; ``rules`` is a list, one each topic, or a single one for one queue."""

    def __init__(self, link, rules, capacity, **settings):
        """``settings``: any of ``SETTINGS``."""
        vars(self).update({**SETTINGS, **settings}, link=link, capacity=capacity)
        self.ask = lambda event: None  # who answers, to be set
        self.one_queue = isinstance(rules, Rules)
        self.rules = [rules] if self.one_queue else rules
        self.max_bytes = self.max_bytes or math.inf
        self.queues = [[] for _ in self.rules]
        self.arrived = [[] for _ in self.rules]  # all that came, kept or not
        self.kept = [[] for _ in self.rules]  # all that was ever enqueued
        self.sent = [[] for _ in self.rules]  # all that the socket took, in that order
        self.socket = []  # Sent, in transmission or behind it
        self.in_flight = []  # sent and not yet answered
        self.acks = []  # (us, message) on their way back
        self.position = 0  # bytes of the link used up when all that the socket took has crossed
        self.held = False  # the scheduler waits for the next arrival or pong
        self.newcomer = None
        self.to_come = self.last_us = 0
        self.now = 0
        self.dequeued, self.transmitted, self.dropped, self.order = {}, {}, {}, []
        self.origin = {}  # by topic, before any of it was sent: the message that entered its empty queue last
        self.limited = set()  # dropped by a rate limit
        self.rejected = self.evicted = self.invalid = 0
        self.evictions = 0  # of those, for the newcomer

    def lane(self, message):
        """Which of the queues the message belongs to."""
        return 0 if self.one_queue else message["topic"]

    def slots(self):
        """All queued messages, oldest first."""
        return sorted((m for queue in self.queues for m in queue), key=lambda m: m["seq"])

    def kept_before(self, message):
        """The message kept before this one (queued, or the newcomer) on its topic; None if it is the first."""
        lane = self.lane(message)
        earlier = [m for m in self.sent[lane] + self.queues[lane] if m["seq"] < message["seq"]]
        return earlier[-1] if earlier else None

    def run(self, messages, first_decision=0, last_decision=math.inf):
        """Meets all messages. ``ask(event)`` answers "decision", "send" and "dequeue", and hears "departure", "end"."""
        self.to_come, self.last_us = len(messages), messages[-1]["us"]
        for message in messages:
            self.advance(message["us"])
            self.now, self.held = message["us"], False
            self.arrive(message, first_decision <= message["seq"] <= last_decision)
        self.advance(math.inf)
        self.ask("end")
        return self

    def arrive(self, message, asked):
        if self.too_soon(message):
            self.drop(message)
            self.limited.add(message["seq"])
            self.rejected += 1
        elif message["bytes"] > self.max_bytes:
            self.drop(message)
            self.rejected += 1
        else:
            asked = asked and not (self.decide_at == "overflow" and self.fits(message))
            self.newcomer = message if asked else None
            self.evictions, settled = 0, False
            while not settled:
                settled = self.carry_out(self.ask("decision") if asked else ACCEPT, message)
            self.newcomer = None
        self.arrived[self.lane(message)].append(message)
        self.to_come -= 1
        self.offer()

    def advance(self, until):
        """All acks and crossings up to and including ``until``; of those at the same time, acks first."""
        while True:
            ack = self.acks[0][0] if self.acks else math.inf
            done = self.socket[0].due if self.socket and self.socket[0].due is not None else math.inf
            if min(ack, done) > until or min(ack, done) == math.inf:
                return
            self.now = min(ack, done)
            if ack <= done:
                self.answered(self.acks.pop(0)[1])
                self.offer()
            else:
                self.crossed()

    def crossed(self):
        """The message in transmission has left; what is taken at this moment follows byte by byte, without a pause."""
        message = self.socket.pop(0).message
        self.transmitted[message["seq"]] = self.now
        self.order.append(message["seq"])
        if self.ack_delay_us > 0:
            self.acks.append((self.now + self.ack_delay_us, message))
        else:
            self.answered(message)
        self.offer(self.position)

    def answered(self, message):
        self.in_flight.remove(message)
        self.held = False

    def offer(self, position=None):
        """The socket takes what it may; into an empty one the first byte goes at ``position``, or at the link's now."""
        while not self.held and any(self.window_open(m) for m in self.slots()):
            head = self.slots()[0]
            if self.drops_heads and self.ask("dequeue") and not self.rules[self.lane(head)].no_drop:
                self.remove(head)
                continue
            message = self.oldest_sendable()
            if self.schedules:
                message = self.choice(self.ask("send"))
            if message is None:
                self.held = True
                return
            self.dequeue(message, position)
            self.ask("departure")

    def dequeue(self, message, position):
        if not self.socket:
            self.position = math.floor(self.link.bytes_by(self.now)) if position is None else position
        self.position += message["bytes"]
        self.socket.append(Sent(message, self.link.first_time(self.position)))
        self.in_flight.append(message)
        self.queues[self.lane(message)].remove(message)
        self.sent[self.lane(message)].append(message)
        self.dequeued[message["seq"]] = self.now

    def window_open(self, message):
        return len(self.in_flight) < self.window or (self.flush_no_drop and self.rules[self.lane(message)].no_drop)

    def sendable(self, message):
        """The oldest of its topic, by n_T and, where rate limits hold back at the socket, by its own."""
        lane = self.lane(message)
        if self.queues[lane][0] is not message or not self.window_open(message):
            return False
        if self.limit_at_send and self.sent[lane] and not self.rules[lane].no_drop:
            return self.now - self.dequeued[self.sent[lane][-1]["seq"]] >= self.rules[lane].period_us
        return True

    def oldest_sendable(self):
        return next((m for m in self.slots() if self.sendable(m)), None)

    def may_hold(self):
        """Something is still to come, or nothing may go."""
        return self.to_come > 0 or bool(self.in_flight) or self.oldest_sendable() is None

    def choice(self, k):
        """The message that the scheduler chose, None to hold; instead of the impossible the oldest that may go."""
        slots = self.slots()
        if k == HOLD and self.may_hold():
            return None
        if 0 <= k < len(slots) and self.sendable(slots[k]):
            return slots[k]
        self.invalid += 1
        return self.oldest_sendable()

    def too_soon(self, message):
        lane = self.lane(message)
        since_us = [self.dequeued[m["seq"]] for m in self.sent[lane]]
        if not self.limit_since_sent:
            since_us = [m["us"] for m in self.kept[lane]]
        if self.limit_at_send or not since_us:
            return False
        return message["us"] - since_us[-1] < self.rules[lane].period_us

    def within_limit(self, message):
        return len(self.queues[self.lane(message)]) < self.rules[self.lane(message)].limit

    def fits(self, message):
        enough_bytes = sum(m["bytes"] for m in [*self.slots(), message]) <= self.max_bytes
        return len(self.slots()) < self.capacity and self.within_limit(message) and enough_bytes

    def evictable(self, message):
        """Queued messages that may go for this one: it fits once all have, if its topic is at its limit its own."""
        may_go = [m for m in self.slots() if not self.rules[self.lane(m)].no_drop]
        stays_bytes = sum(m["bytes"] for m in self.slots() if m not in may_go)
        if stays_bytes + message["bytes"] > self.max_bytes:
            return []
        return [m for m in may_go if self.within_limit(message) or self.lane(m) == self.lane(message)]

    def must_keep(self, message):
        return self.rules[self.lane(message)].no_drop and (self.fits(message) or bool(self.evictable(message)))

    def carry_out(self, decision, message):
        """Whether the message has been enqueued or dropped; if not, the policy is asked again."""
        slots = self.slots()
        if decision == ACCEPT and self.fits(message):
            self.enqueue(message)
        elif decision == REJECT and not self.must_keep(message):
            self.drop(message)
            self.rejected += 1
        elif 0 <= decision < len(slots) and slots[decision] in self.evictable(message):
            return self.make_way(slots[decision], message)
        else:
            # What a queue does, but a no_drop message drives out the least important.
            self.invalid += 1
            if not self.fits(message) and self.must_keep(message):
                lowest = min(self.evictable(message), key=lambda m: self.rules[self.lane(m)].priority)
                return self.make_way(lowest, message)
            if self.fits(message):
                self.enqueue(message)
            else:
                self.drop(message)
                self.rejected += 1
        return True

    def make_way(self, victim, message):
        self.remove(victim)
        self.evictions += 1
        if not self.fits(message):
            return False
        self.enqueue(message)
        return True

    def enqueue(self, message):
        if not self.sent[self.lane(message)] and not self.queues[self.lane(message)]:
            self.origin[self.lane(message)] = message
        self.queues[self.lane(message)].append(message)
        self.kept[self.lane(message)].append(message)

    def remove(self, message):
        self.queues[self.lane(message)].remove(message)
        self.drop(message)
        self.evicted += 1

    def drop(self, message):
        self.dropped[message["seq"]] = self.now

    def gain(self, lane, messages):
        """Weight x sum of V over these messages of one topic."""
        return self.rules[lane].weight * sum(self.rules[lane].v(b["x"] - a["x"]) for a, b in pairwise(messages))

    def retained_gain(self):
        return sum(self.gain(k, self.sent[k] + self.queues[k]) for k in range(len(self.rules)))

    def received(self, lane, until):
        """(when, message) of what reached the server by then."""
        crossed = [m for m in self.sent[lane] if m["seq"] in self.transmitted]
        at = [(self.transmitted[m["seq"]] + self.propagation_us, m) for m in crossed]
        return [(us, m) for us, m in at if us <= until]

    def delivered_gain(self, until):
        return sum(self.gain(k, [m for _, m in self.received(k, until)]) for k in range(len(self.rules)))

    def aged(self, until, to_the_end=False):
        """Weight x age of information integrated, s^2: from a topic's first arrival to its last receipt, or the end.

        Nothing counts after the last arrival of all, ``self.last_us``. Between receipts the age is t minus a constant,
        so its integral is that of t less a rectangle.
        """
        total = Fraction(0)
        for lane, arrived in enumerate(self.arrived):
            if not arrived:
                continue
            knots = [(arrived[0]["us"], arrived[0]["us"])]  # (from when, arrival time of the newest then)
            knots += [(min(us, self.last_us), m["us"]) for us, m in self.received(lane, until)]
            end = max(min(until, self.last_us), knots[-1][0]) if to_the_end else knots[-1][0]
            area = Fraction(end**2 - knots[0][0] ** 2, 2)
            for (us, newest), (next_us, _) in pairwise([*knots, (end, None)]):
                area -= newest * (next_us - us)
            total += Fraction(self.rules[lane].weight) * area / 10**12
        return float(total)

    def late(self, until):
        """Sum of the weights of messages older than their deadline when they reached the server."""
        ages = [(r, us - m["us"]) for lane, r in enumerate(self.rules) for us, m in self.received(lane, until)]
        return sum(rules.weight for rules, age_us in ages if age_us > rules.deadline_us)

    def left_bytes(self):
        """Bytes that the socket took and that have not crossed yet."""
        inside = sum(sent.message["bytes"] for sent in self.socket)
        if not self.socket or (len(self.socket) == 1 and self.dequeued[self.socket[0].message["seq"]] == self.now):
            return inside
        return min(inside, max(0, self.position - math.floor(self.link.bytes_by(self.now))))

    def reference(self):
        """What the newcomer's topic has behind it: what was sent last, else the arrival before all that is queued."""
        lane = self.lane(self.newcomer)
        if self.sent[lane]:
            return self.sent[lane][-1]
        return min(self.queues[lane] + self.arrived[lane][-1:] + [self.newcomer], key=lambda m: m["seq"])

    def gaps(self, message, field):
        """Distances of a queued message, or of the newcomer, to what is before and after it on its topic."""
        lane = self.lane(message)
        arrived = self.arrived[lane]
        before = self.kept_before(message)
        if before is None:  # nothing was kept: the arrival before it, or itself
            before = min([*arrived[-1:], message], key=lambda m: m["seq"])
        if message is self.newcomer:
            return message[field] - before[field], message[field] - [message, *arrived][-1][field]
        later = [m for m in self.queues[lane] if m["seq"] > message["seq"]]
        if later:
            after = later[0][field]
        elif self.lane(self.newcomer) == lane:
            after = self.newcomer[field]
        else:  # one more step like the last
            after = arrived[-1][field] + (arrived[-1][field] - arrived[-2:][0][field])
        return message[field] - before[field], after - message[field]
