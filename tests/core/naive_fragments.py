"""Slow, obvious reference models of middleware that sends in fragments, and of WebRTC's frame dropper."""

import itertools
import math

from naive_queues import ACCEPT, REJECT, KeepLast, Policy


class Pipe:
    """What lies ahead of a newcomer, lost fragments included; times in us, the rate in bytes/us, None for unknown."""

    def __init__(self, rate_memory_s):
        self.rate_memory_us = rate_memory_s * 1e6
        self.ahead = self.own = self.since = self.seen = 0
        self.rate = None

    def look(self, queue, sender, now):
        own, passed = sum(m["bytes"] for m in queue) + sender.left_bytes(), now - self.since
        if self.own > 0 and passed > 0 and own <= self.own:
            rate = (self.own - own) / passed
            if own > 0:
                self.rate = rate
            elif self.rate is not None:  # an idle link may have been faster
                self.rate = max(self.rate, rate)
            self.seen = now
        if now - self.seen > self.rate_memory_us:
            self.rate = None
        self.now, self.unsent = now, own
        if self.rate is None:  # all but what came at this very moment
            return own if passed > 0 else max(own, self.ahead)
        return max(own, math.floor(self.ahead - self.rate * passed))

    def note(self, ahead, kept):
        self.ahead, self.own, self.since = ahead, self.unsent + kept, self.now


class ZenohDrop(Policy):
    """Zenoh's dropping of what would wait too long; batches and buffers in bytes, waits in us."""

    def __init__(
        self,
        batch_size=65_535,
        queue_size=2,
        so_sndbuf=131_072,
        wait_before_drop=1_000,
        max_wait_before_drop_fragments=50_000,
        rate_memory_s=1,
    ):
        self.batch_bytes, self.wait_us, self.more_us = batch_size, wait_before_drop, max_wait_before_drop_fragments
        self.room_bytes, self.pipe = queue_size * batch_size + 2 * so_sndbuf, Pipe(rate_memory_s)

    def deadlines(self):
        """wait_us (1 + 2 + 4 + ...), the first left as it is and the others cut at ``more_us`` in all."""
        for k in itertools.count():
            yield self.wait_us + min(self.more_us, self.wait_us * (2 ** (k + 1) - 2))

    def decide(self, queue, newcomer):
        ahead = self.pipe.look(queue, self.sender, newcomer["us"])
        size, put = newcomer["bytes"], 0
        if not self.sender.fits(newcomer):
            self.pipe.note(ahead, 0)
            return REJECT
        for deadline in self.deadlines():
            if put == size:
                self.pipe.note(ahead + size, size)
                return ACCEPT
            more = min(put + self.batch_bytes, size)
            if self.pipe.rate is not None and ahead + more - self.pipe.rate * deadline > self.room_bytes:
                self.pipe.note(ahead + put, 0)
                return REJECT
            put = more


class BestEffort(Policy):
    def __init__(self, queue_kb=200, rate_memory_s=1):
        self.room, self.pipe = queue_kb * 1e3, Pipe(rate_memory_s)

    def decide(self, queue, newcomer):
        ahead = self.pipe.look(queue, self.sender, newcomer["us"])
        at_once = ahead + newcomer["bytes"] <= self.room
        kept = newcomer["bytes"] if at_once and self.sender.fits(newcomer) else 0
        self.pipe.note(max(ahead, min(self.room, ahead + newcomer["bytes"])), kept)
        return ACCEPT if kept else REJECT


class Reliable(KeepLast):
    def __init__(self, queue_kb=200, depth=10, rate_memory_s=1):
        super().__init__(depth)
        self.room, self.pipe = queue_kb * 1e3, Pipe(rate_memory_s)

    def decide(self, queue, newcomer):
        decision = super().decide(queue, newcomer)
        if self.sender.evictions > 0:
            self.pipe.own -= queue[0]["bytes"] if decision == 0 else 0
            return decision
        ahead, rate = self.pipe.look(queue, self.sender, newcomer["us"]), self.pipe.rate
        depth, size = min(self.depth, self.sender.capacity), newcomer["bytes"]
        in_time = rate is None or ahead + depth * size <= rate * depth * self.sender.periods[-1]
        kept = size - queue[0]["bytes"] if decision == 0 else size
        if ahead + size > self.room and not in_time:
            decision, kept = REJECT, 0
        self.pipe.note(min(ahead + size, self.pipe.unsent + depth * size), kept)
        return decision


class FrameDropper(Policy):
    """frame_dropper.cc, method by method, its bits as bytes/us and bytes; ``rate`` is the target."""

    def __init__(self):
        self.pipe = Pipe(math.inf)
        self.accumulator = self.target = self.ratio = self.drop_count = 0
        self.average, self.large_count, self.large_chunk = None, 0, 0
        self.drop_next, self.was_below_max = False, True

    def decide(self, queue, newcomer):
        ahead = self.pipe.look(queue, self.sender, newcomer["us"])
        keep = self.sender.fits(newcomer)
        if self.pipe.rate is not None:
            self.set_rates(self.pipe.rate)
            self.leak()
            keep = self.target > 0 and not self.drop_frame() and keep
            if keep:
                self.fill(newcomer["bytes"])
        kept = newcomer["bytes"] if keep else 0
        self.pipe.note(ahead + kept, kept)
        return ACCEPT if keep else REJECT

    def frame_us(self):
        return max(1.0, self.sender.periods[-1])

    def set_rates(self, target):
        self.maximum = 1e6 * 0.5 * target
        if 0 < self.target and target < self.target and self.accumulator > self.maximum:
            self.accumulator *= target / self.target
        self.target = target
        self.accumulator = min(self.accumulator, 1e6 * 3.0 * target)

    def leak(self):
        expected = self.target * self.frame_us()
        if self.large_count > 0:
            expected -= self.large_chunk
            self.large_count -= 1
        self.accumulator = max(0.0, self.accumulator - expected)
        alpha = 0.8 if self.accumulator > 1.3 * self.maximum else 0.9
        if self.accumulator > self.maximum:
            self.drop_next = self.drop_next or self.was_below_max
            self.ratio = min(0.96, alpha * self.ratio + (1 - alpha) * 1)
        else:
            self.ratio = alpha * self.ratio
        self.was_below_max = self.accumulator < self.maximum

    def drop_frame(self):
        if self.drop_next:
            self.drop_next, self.drop_count = False, 0
        if self.ratio >= 0.5:
            limit = min(int(1 / max(1 - self.ratio, 1e-5) - 1 + 0.5), int(1e6 * 4.0 / self.frame_us()))
            self.drop_count = abs(self.drop_count)
            if self.drop_count < limit:
                self.drop_count += 1
                return True
        elif self.ratio > 0:
            limit = -int(1 / max(self.ratio, 1e-5) - 1 + 0.5)
            self.drop_count = -abs(self.drop_count)
            if self.drop_count > limit:
                self.drop_count -= 1
                return self.drop_count == -1
        self.drop_count = 0
        return False

    def fill(self, size):
        if self.average is not None and size > 3 * self.average and self.large_count == 0:
            self.large_count = int(max(0.5e6 / self.frame_us(), 5.0) + 0.5)
            self.large_chunk = size / self.large_count
            return
        self.average = size if self.average is None else 0.9 * self.average + (1 - 0.9) * size
        self.accumulator = min(self.accumulator + size, 1e6 * 3.0 * self.target)
