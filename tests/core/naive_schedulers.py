"""Slow, obvious twins of the schedulers: lists of messages, what each client remembers itself, no kernels.

Messages are dictionaries (seq, us, bytes, topic), oldest first. ``decide`` answers with the message to evict, or ACCEPT
or REJECT; ``choose`` with the message to send, None to wait.
"""

from __future__ import annotations

import math

from naive_sender import ACCEPT, REJECT


class Fifo:
    def __init__(self, topics, capacity, max_bytes=None):
        self.topics, self.capacity = topics, capacity
        self.max_bytes = math.inf if max_bytes is None else max_bytes
        self.newest_sent, self.last_sent = {}, {}  # by topic: arrival time of the newest that was sent, and when

    def fits(self, queue, newcomer):
        same = [m for m in queue if m["topic"] == newcomer["topic"]]
        limit = self.topics[newcomer["topic"]].limit or math.inf
        few_bytes = sum(m["bytes"] for m in [*queue, newcomer]) <= self.max_bytes
        return len(queue) < self.capacity and len(same) < limit and few_bytes

    def helpful(self, queue, newcomer):
        """What may go, where the newcomer fits in the end; of its own topic while that is at its limit."""
        droppable = [m for m in queue if not self.topics[m["topic"]].no_drop]
        same = [m for m in queue if m["topic"] == newcomer["topic"]]
        if sum(m["bytes"] for m in [*queue, newcomer]) - sum(m["bytes"] for m in droppable) > self.max_bytes:
            return []
        return droppable if len(same) < (self.topics[newcomer["topic"]].limit or math.inf) else same

    def decide(self, queue, newcomer):
        if self.fits(queue, newcomer):
            return ACCEPT
        helpful = self.helpful(queue, newcomer)
        for m in helpful:
            if m["topic"] == newcomer["topic"]:
                return m
        new = self.topics[newcomer["topic"]]
        if helpful:
            lowest = min(self.topics[m["topic"]].priority for m in helpful)
            if new.no_drop or lowest <= new.priority:
                return next(m for m in helpful if self.topics[m["topic"]].priority == lowest)
        return REJECT

    def choose(self, queue, now, in_flight, window):
        chosen = self.pick(queue, now, in_flight, window)
        if chosen is not None:
            self.newest_sent[chosen["topic"]] = chosen["us"]
            self.last_sent[chosen["topic"]] = now
        return chosen

    def pick(self, queue, now, in_flight, window):
        return queue[0]

    def heads(self, queue):
        """The oldest of each topic."""
        first = {}
        for m in queue:
            first.setdefault(m["topic"], m)
        return list(first.values())


class StrictPriority(Fifo):
    def pick(self, queue, now, in_flight, window):
        return sorted(queue, key=lambda m: (-self.topics[m["topic"]].priority, m["seq"]))[0]


class AgeGreedy(Fifo):
    def pick(self, queue, now, in_flight, window):
        def age(m):
            return self.topics[m["topic"]].share * (now - self.newest_sent.get(m["topic"], m["us"]))

        return sorted(self.heads(queue), key=lambda m: (-age(m), m["seq"]))[0]


class Edf(Fifo):
    def pick(self, queue, now, in_flight, window):
        def due(m):
            deadline_s = self.topics[m["topic"]].deadline_s
            return math.inf if deadline_s is None else m["us"] + round(1e6 * deadline_s)

        return sorted(queue, key=lambda m: (due(m), m["seq"]))[0]


class Robofleet(Fifo):
    def decide(self, queue, newcomer):
        for m in self.helpful(queue, newcomer):
            if m["topic"] == newcomer["topic"]:
                return m
        return super().decide(queue, newcomer)

    def wait(self, m, now):
        return self.topics[m["topic"]].priority * (now - self.last_sent.get(m["topic"], 0))

    def pick(self, queue, now, in_flight, window):
        for m in queue:
            if self.topics[m["topic"]].no_drop:
                return m
        return sorted(self.heads(queue), key=lambda m: (-self.wait(m, now), m["topic"]))[0]


class RobofleetReleased(Robofleet):
    """``schedule`` is the code's, step by step: it sends a whole pass, which the socket here takes one by one."""

    def __init__(self, *settings):
        super().__init__(*settings)
        self.to_send = []

    def pick(self, queue, now, in_flight, window):
        if not self.to_send:
            self.to_send = self.schedule(queue, now, in_flight, window)
        return self.to_send.pop(0) if self.to_send else None

    def schedule(self, queue, now, counter, window):
        if counter >= window:
            return []
        sent = [m for m in queue if self.topics[m["topic"]].no_drop]
        counter += len(sent)
        if counter >= window:
            return sent
        candidates = []
        for m in self.heads(queue):
            topic = self.topics[m["topic"]]
            since = now - self.last_sent.get(m["topic"], -math.inf)
            if not topic.no_drop and since >= topic.period_us:
                candidates.append(m)
        candidates.sort(key=lambda m: (self.wait(m, now), m["topic"]))
        return sent + candidates[: window - counter]


class RosNative(Fifo):
    def decide(self, queue, newcomer):
        if self.fits(queue, newcomer):
            return ACCEPT
        helpful = self.helpful(queue, newcomer)
        own = [m for m in helpful if m["topic"] == newcomer["topic"]]
        return [*own, *helpful, REJECT][0]

    def pick(self, queue, now, in_flight, window):
        return sorted(self.heads(queue), key=lambda m: (self.last_sent.get(m["topic"], 0), m["topic"]))[0]


TWINS = {
    "fifo": Fifo,
    "strict-priority": StrictPriority,
    "age-greedy": AgeGreedy,
    "edf": Edf,
    "robofleet": Robofleet,
    "robofleet-literal": Robofleet,
    "robofleet-released": RobofleetReleased,
    "ros-native": RosNative,
}
