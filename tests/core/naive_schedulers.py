"""Slow, obvious reference models of the schedulers: each answers from what its ``naive_sender.Sender`` knows."""

import math

from naive_sender import ACCEPT, HOLD, REJECT


class Fifo:
    def __init__(self, sender):
        self.sender, self.rules = sender, sender.rules
        sender.ask = self.answer

    def answer(self, event):
        if event == "decision":
            decided = self.decide(self.sender.newcomer)
            return decided if decided in (ACCEPT, REJECT) else self.sender.slots().index(decided)
        if event == "send":
            sent = self.pick(self.sender.slots(), self.sender.now)
            return HOLD if sent is None else self.sender.slots().index(sent)
        return None

    def decide(self, newcomer):
        """The message to evict, or ACCEPT or REJECT."""
        if self.sender.fits(newcomer):
            return ACCEPT
        helpful, new = self.sender.evictable(newcomer), self.rules[newcomer["topic"]]
        own = [m for m in helpful if m["topic"] == newcomer["topic"]]
        if not own and helpful:
            lowest = min(self.rules[m["topic"]].priority for m in helpful)
            if new.no_drop or lowest <= new.priority:
                own = [m for m in helpful if self.rules[m["topic"]].priority == lowest]
        return [*own, REJECT][0]

    def pick(self, queue, now):
        """The message to send, None to wait."""
        return queue[0]

    def heads(self):
        """The oldest of each topic."""
        return sorted((queue[0] for queue in self.sender.queues if queue), key=lambda m: m["seq"])

    def last_sent(self, topic, never=0):
        sent = self.sender.sent[topic]
        return self.sender.dequeued[sent[-1]["seq"]] if sent else never


class StrictPriority(Fifo):
    def pick(self, queue, now):
        return sorted(queue, key=lambda m: (-self.rules[m["topic"]].priority, m["seq"]))[0]


class AgeGreedy(Fifo):
    def pick(self, queue, now):
        def age(m):
            return self.rules[m["topic"]].weight * (now - [m, *self.sender.sent[m["topic"]]][-1]["us"])

        return sorted(self.heads(), key=lambda m: (-age(m), m["seq"]))[0]


class Edf(Fifo):
    def pick(self, queue, now):
        return sorted(queue, key=lambda m: (m["us"] + self.rules[m["topic"]].deadline_us, m["seq"]))[0]


class Robofleet(Fifo):
    def decide(self, newcomer):
        own = [m for m in self.sender.evictable(newcomer) if m["topic"] == newcomer["topic"]]
        return own[0] if own else super().decide(newcomer)

    def wait(self, m, now):
        return self.rules[m["topic"]].priority * (now - self.last_sent(m["topic"]))

    def pick(self, queue, now):
        kept = [m for m in queue if self.rules[m["topic"]].no_drop]
        return [*kept, *sorted(self.heads(), key=lambda m: (-self.wait(m, now), m["topic"]))][0]


class RobofleetReleased(Robofleet):
    """``schedule`` is the code's, step by step: it sends a whole pass, which the socket here takes one by one."""

    to_send = ()

    def pick(self, queue, now):
        if not self.to_send:
            self.to_send = self.schedule(queue, now, len(self.sender.in_flight), self.sender.window)
        return self.to_send.pop(0) if self.to_send else None

    def schedule(self, queue, now, counter, window):
        if counter >= window:
            return []
        sent = [m for m in queue if self.rules[m["topic"]].no_drop]
        counter += len(sent)
        if counter >= window:
            return sent
        candidates = []
        for m in self.heads():
            rules = self.rules[m["topic"]]
            if not rules.no_drop and now - self.last_sent(m["topic"], -math.inf) >= rules.period_us:
                candidates.append(m)
        candidates.sort(key=lambda m: (self.wait(m, now), m["topic"]))
        return sent + candidates[: window - counter]


class RosNative(Fifo):
    def decide(self, newcomer):
        if self.sender.fits(newcomer):
            return ACCEPT
        helpful = self.sender.evictable(newcomer)
        return [*(m for m in helpful if m["topic"] == newcomer["topic"]), *helpful, REJECT][0]

    def pick(self, queue, now):
        return sorted(self.heads(), key=lambda m: (self.last_sent(m["topic"]), m["topic"]))[0]


REFERENCES = {
    "fifo": Fifo,
    "strict-priority": StrictPriority,
    "age-greedy": AgeGreedy,
    "edf": Edf,
    "robofleet": Robofleet,
    "robofleet-literal": Robofleet,
    "robofleet-released": RobofleetReleased,
    "ros-native": RosNative,
}
