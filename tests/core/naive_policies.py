"""Slow, obvious reference models of the policies, from their papers' descriptions: lists and dictionaries."""

import math
from fractions import Fraction

import naive_queues as queues
from naive_fragments import BestEffort, FrameDropper, Reliable, ZenohDrop


class Reservoir(queues.Policy):
    """Algorithm R: the n-th item takes a place of its own with probability L / n."""

    n = 0

    def decide(self, queue, newcomer):
        again, s = self.sender.evictions > 0, len(queue)
        if not again:
            self.n = max(self.n, s) + 1  # what came unasked is all there
        if self.sender.fits(newcomer):
            return queues.ACCEPT
        places = [*range(s), *[queues.REJECT] * (0 if again else self.n - s)]
        return queues.one_of(places, queues.uniform_of(newcomer, self.sender))

    def departed(self, queue):
        self.n = len(queue)


class Decimate(queues.Policy):
    """Arrivals 1, 4, 7, ... enter a queue that drops its oldest."""

    n = 0

    def decide(self, queue, newcomer):
        if self.sender.evictions == 0:
            self.n += 1
            if self.n not in range(1, self.n + 1, 3):
                return queues.REJECT
        return queues.ACCEPT if self.sender.fits(newcomer) else 0


class Afr(queues.Policy):
    """AFR: dropping rate r, counter c, dropping position p."""

    def __init__(self, as_released=True):
        self.r, self.c, self.p, self.as_released = 1, 0, 0, as_released

    def departed(self, queue):
        if self.as_released and self.p > 0:
            self.p -= 1

    def decide(self, queue, newcomer):
        L = self.sender.capacity
        filled, backlog = Fraction(len(queue), L), sum(m["bytes"] for m in queue)
        if self.sender.max_bytes < math.inf:
            filled = max(filled, Fraction(backlog, self.sender.max_bytes))
        low = filled <= Fraction(2, 3) if self.as_released else filled < Fraction(2, 3)
        like_these = self.sender.max_bytes * (len(queue) + 1) / (backlog + newcomer["bytes"])
        self.full_length = L if like_these >= L else math.floor(like_these)
        if self.sender.evictions == 0:
            if self.r > 1 and low:
                self.r //= 2
                self.c %= self.gap()
        return self.count(queue, newcomer)

    def gap(self):
        return self.r

    def count(self, queue, newcomer):
        if self.sender.evictions == 0:
            self.c += 1
            if self.c < self.gap():
                return queues.REJECT
            self.c = math.fmod(self.c - self.gap(), 1)
        if self.sender.fits(newcomer):
            return queues.ACCEPT
        self.end_pass(queue)
        victim = self.p
        self.p += 1
        self.end_pass(queue)
        return victim

    def end_pass(self, queue):
        if self.p >= len(queue):
            self.r *= 2
            self.p = 0


def gaps_left(sender, queue, newcomer, key):
    """The merged gap that each queued message, and last the newcomer, would leave; the next step is like the last."""
    at = [m[key] for m in [sender.last_dequeued, *queue, newcomer]]
    at.append(at[-1] + at[-1] - sender.previous[key])
    return [after - before for before, after in zip(at, at[2:], strict=False)]


def least(gaps, own, sizes, excess, again):
    """What leaves the smallest gap, ties to the oldest.

    Under B the newcomer goes where those that leave no larger a gap don't make room; once one has gone, it stays.
    """
    if not gaps or (not again and own < min(gaps)):
        return queues.REJECT
    freed = sum(size for size, gap in zip(sizes, gaps, strict=True) if gap <= own)
    return gaps.index(min(gaps)) if again or freed >= excess else queues.REJECT


def min_gap(key):
    def full(sender, queue, newcomer):
        *gaps, own = gaps_left(sender, queue, newcomer, key)
        sizes = [m["bytes"] for m in queue]
        return least(gaps, own, sizes, sum(sizes) + newcomer["bytes"] - sender.max_bytes, sender.evictions > 0)

    return queues.Policy(full)


def orbbuf(v):
    """Drop the message with the most similar neighbours, the first of equals; the head's is the one that left last."""

    def full(sender, queue, newcomer):
        if len(queue) < 3:
            return len(queue) - 1
        older = [sender.last_dequeued, *queue]
        similar = [1 - v(c["x"] - a["x"]) for a, c in zip(older, older[2:], strict=False)]
        return similar.index(max(similar))

    return queues.Policy(full)


def spread(key, share, discount):
    """A newcomer within ``share`` even gaps of the tail goes, else the smallest gap, the older the smaller."""

    def full(sender, queue, newcomer):
        L = len(queue)
        even = share * (newcomer[key] - sender.last_dequeued[key]) / (L + 1)
        if newcomer[key] - queue[-1][key] < even and sender.evictions == 0:
            return queues.REJECT
        gaps = gaps_left(sender, queue, newcomer, key)[:L]
        counted = [gap * (1 - discount * (1 - k / L)) for k, gap in enumerate(gaps)]
        return counted.index(min(counted))

    return queues.Policy(full)


def greedy_qoi(v):
    """The first of the slots whose eviction for the newcomer adds most; reject if none adds more than rounding."""

    def loss(a, b):
        if "exponential" in v.name:
            return v(a) * v(b)  # equal, and rounded as in the kernel
        return v(a) + v(b) - v(a + b)

    def full(sender, queue, newcomer):
        x = [m["x"] for m in [sender.last_dequeued, *queue, newcomer]]
        gain = v(x[-1] - x[-2])
        added = [gain - loss(b - a, c - b) for a, b, c in zip(x, x[1:], x[2:], strict=False)]
        victim, most = queues.REJECT, 0.0 if sender.evictions == 0 else -math.inf
        for k, gain in enumerate(added):
            if gain > most + 1e-12:
                victim, most = k, gain
        return victim

    return queues.Policy(full)


class LinearAlpha(Afr):
    """AFR with kept message i at time L (i / L)^alpha; while nothing is lowered, what finds room is kept."""

    def __init__(self, alpha=1.302):
        super().__init__()
        self.alpha = alpha

    def gap(self):
        a, L = self.alpha, self.full_length  # of a queue of messages like the present ones
        return float(self.r) ** a * float(L) ** (1 - a) * (float(L + self.p + 1) ** a - float(L + self.p) ** a)

    def count(self, queue, newcomer):
        if self.r == 1 and self.sender.fits(newcomer):
            self.c = 0
            return queues.ACCEPT
        return super().count(queue, newcomer)


class Steady(queues.Policy):
    """Of the numbers m, 2m, 4m, ... (m odd) the last few are kept: s + 1 if m = 1, else s - floor(log2 m)."""

    first = 0

    def place(self, n, L):
        """Two numbers want the same place if they have this in common; None: not kept."""
        s = math.floor(math.log2(L))
        h = max(h for h in range(n.bit_length()) if n % 2**h == 0)
        m = n // 2**h
        width = s + 1 if m == 1 else s - math.floor(math.log2(m))
        return (m, h % width) if width > 0 else None

    def decide(self, queue, newcomer):
        if not queue:
            self.first = newcomer["seq"]
        places = [self.place(m["seq"] - self.first + 1, self.sender.capacity) for m in [*queue, newcomer]]
        place = places.pop()
        if place is None:
            return queues.REJECT
        if place in places:
            return places.index(place)
        return queues.ACCEPT if self.sender.fits(newcomer) else 0


class Anything(queues.Policy):
    """A policy that decides at random, invalid decisions included: -2 accept, -1 reject, 0 .. L + 1 a slot."""

    def decide(self, queue, newcomer):
        return queues.one_of([queues.ACCEPT, queues.REJECT, *range(self.sender.capacity + 2)], newcomer["uniform"])


def references(v):
    """What makes the reference model of each built-in policy, by name."""
    return {
        "drop-oldest": lambda: queues.Policy(lambda sender, queue, newcomer: 0),
        "drop-newest": lambda: queues.Policy(queues.drop_newest),
        "replace-newest": lambda: queues.Policy(lambda sender, queue, newcomer: len(queue) - 1),
        "latest-only": lambda: queues.KeepLast(1),
        "random": lambda: queues.Policy(queues.drop_random),
        "reservoir": Reservoir,
        "decimate": Decimate,
        "keyframe": lambda step=0.05: queues.Spaced("x", step),
        "afr": Afr,
        "afr-paper": lambda: Afr(as_released=False),
        "linear-alpha": LinearAlpha,
        "steady": Steady,
        "min-gap": lambda: min_gap("us"),
        "min-motion-gap": lambda: min_gap("x"),
        "even-reject": lambda beta=1.3: spread("us", beta, 0),
        "paced-motion-gap": lambda pace=0.7, discount=0.35: spread("x", pace, discount),
        "orbbuf": lambda: orbbuf(v),
        "greedy-qoi": lambda: greedy_qoi(v),
        "ros-keep-last": lambda depth=10: queues.KeepLast(depth),
        "dds-keep-all": lambda: queues.Policy(queues.drop_newest),
        "lifespan": queues.Lifespan,
        "time-filter": lambda separation_s=0.1: queues.Spaced("us", separation_s * 1e6),
        "zenoh-drop": ZenohDrop,
        "ros2-best-effort": BestEffort,
        "ros2-reliable-udp": Reliable,
        "webrtc-frame-dropper": FrameDropper,
        "zenoh-ring": queues.KeepLast,
        "foxglove-sdk": lambda depth=1024: queues.KeepLast(depth),
        "foxglove-backlog": queues.FoxgloveBacklog,
        "rosbridge": queues.Rosbridge,
        "codel": queues.Codel,
        "red": queues.Red,
        **dict.fromkeys(["fifo", "strict-priority", "age-greedy", "edf", "ros-native"], queues.KeepLast),
        **dict.fromkeys(["robofleet", "robofleet-literal", "robofleet-released"], lambda: queues.KeepLast(1)),
        "test-anything": Anything,
    }


def policy(spec, v):
    """The reference model of the built-in policy of that name, with settings as in ``decimate:every=2``."""
    name, _, settings = spec.partition(":")
    pairs = [setting.split("=") for setting in settings.split(",") if setting]
    return references(v)[name](**{key: float(number) for key, number in pairs})
