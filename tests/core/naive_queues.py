"""Slow, obvious reference models of what middleware and networks do; ``naive_policies`` has the others."""

import math

from naive_sender import ACCEPT, REJECT


class Policy:
    """``decide`` says what to do with a newcomer, ``full`` where there is no room; ``departed`` hears what is left."""

    sender = None  # whose policy it is

    def __init__(self, full=None):
        self.full = full  # (sender, queue, newcomer) -> the slot to evict, or REJECT

    def decide(self, queue, newcomer):
        return ACCEPT if self.sender.fits(newcomer) else self.full(self.sender, queue, newcomer)

    def departed(self, queue):
        pass

    def unwanted(self, queue, now):
        """How many heads are to be dropped before the socket takes one."""
        return 0


def drop_newest(sender, queue, newcomer):
    return REJECT


def one_of(candidates, uniform):
    """A candidate, each as likely as the others."""
    return candidates[math.floor(uniform * len(candidates))]


def uniform_of(newcomer, sender):
    """Its draw; for each time that it is asked about again, the next of Lehmer's sequence."""
    uniform = newcomer["uniform"]
    for _ in range(sender.evictions):
        uniform = math.fmod(7919 * uniform, 1)
    return uniform


def drop_random(sender, queue, newcomer):
    """The victim is uniform over the queue and the newcomer, which stays once a message has gone for it."""
    stays = [REJECT] * (sender.evictions == 0)
    return one_of([*range(len(queue)), *stays], uniform_of(newcomer, sender))


class KeepLast(Policy):
    """The newest ``depth`` are kept, or L if that is fewer."""

    def __init__(self, depth=math.inf):
        self.depth = depth

    def decide(self, queue, newcomer):
        return 0 if len(queue) >= self.depth or not self.sender.fits(newcomer) else ACCEPT


class Lifespan(KeepLast):
    """Heads older than this are not sent."""

    def __init__(self, lifespan_s=0.5):
        super().__init__()
        self.lifespan_us = lifespan_s * 1e6

    def unwanted(self, queue, now):
        return sum(now - m["us"] > self.lifespan_us for m in queue)


class Spaced(KeepLast):
    """At least so far in ``key`` beyond the message accepted before it."""

    def __init__(self, key, distance):
        super().__init__()
        self.key, self.distance = key, distance

    def decide(self, queue, newcomer):
        accepted = [*self.sender.sent[0], *queue]
        if accepted and newcomer[self.key] - accepted[-1][self.key] < self.distance:
            return REJECT
        return super().decide(queue, newcomer)


class FoxgloveBacklog(Policy):
    """All bytes that have not left yet, with the newcomer's, stay below the limit."""

    def __init__(self, limit_mb=10):
        self.limit = limit_mb * 1e6

    def decide(self, queue, newcomer):
        waiting = sum(m["bytes"] for m in queue) + self.sender.left_bytes()
        if waiting + newcomer["bytes"] >= self.limit or not self.sender.fits(newcomer):
            return REJECT
        return ACCEPT


class Rosbridge(Policy):
    def decide(self, queue, newcomer):
        return ACCEPT


class Codel(Policy):
    """RFC 8289, 5.5 and 5.6, with its loop as it stands there; times in us, 0 for none."""

    def __init__(self, target_ms=5, interval_ms=100):
        super().__init__(drop_newest)
        self.target, self.interval = target_ms * 1e3, interval_ms * 1e3
        self.first_above = self.drop_next = self.count = self.lastcount = self.maxpacket = 0
        self.dropping = False

    def dodequeue(self, queue, now):
        if not queue:
            self.first_above = 0
            return False
        packet = queue.pop(0)
        self.maxpacket = max(self.maxpacket, packet["bytes"])
        if now - packet["us"] < self.target or sum(m["bytes"] for m in queue) <= self.maxpacket:
            self.first_above = 0
            return False
        if self.first_above == 0:
            self.first_above = now + self.interval
            return False
        return now >= self.first_above

    def control_law(self, t):
        return t + self.interval / math.sqrt(self.count)

    def unwanted(self, queue, now):
        drops = 0
        ok = self.dodequeue(queue, now)
        if self.dropping:
            if not ok:
                self.dropping = False
            while self.dropping and now >= self.drop_next:
                drops += 1
                self.count += 1
                if self.dodequeue(queue, now):
                    self.drop_next = self.control_law(self.drop_next)
                else:
                    self.dropping = False
        elif ok:
            drops += 1
            self.dodequeue(queue, now)
            self.dropping = True
            delta = self.count - self.lastcount
            self.count = 1
            if delta > 1 and now - self.drop_next < 16 * self.interval:
                self.count = delta
            self.drop_next = self.control_law(now)
            self.lastcount = self.count
        return drops


class Red(Policy):
    """Floyd and Jacobson 1993, Fig. 2, without idle times."""

    def __init__(self, min_th=0.25, max_th=0.75, max_p=0.1, weight=0.2):
        self.min_th, self.max_th, self.max_p, self.weight = min_th, max_th, max_p, weight
        self.average, self.count = 0, -1

    def decide(self, queue, newcomer):
        L, in_bytes = self.sender.capacity, sum(m["bytes"] for m in queue) / self.sender.max_bytes
        self.average += self.weight * (max(len(queue), L * in_bytes) - self.average)
        filled = self.average / L
        if self.min_th <= filled < self.max_th:
            self.count += 1
            p = self.max_p * (filled - self.min_th) / (self.max_th - self.min_th)
            # uniform < p / (1 - count p), or certain where that is no probability
            if newcomer["uniform"] * (1 - self.count * p) < p:
                self.count = 0
                return REJECT
        elif filled >= self.max_th:
            self.count = 0
            return REJECT
        else:
            self.count = -1
        return ACCEPT if self.sender.fits(newcomer) else REJECT
