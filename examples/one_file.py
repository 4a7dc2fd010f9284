"""A whole step in one file: one sender, one link, AFR, and the environment of one queue with ordered candidates.

This is `bufgym/Uplink-v1` with its default actions and reward, in plain Python. It leaves out byte limits, topics, acks
and speed. A test plays 200 random episodes here and in bufgym: the drops, H, rewards and observations are the same.
"""

import itertools
import math
from bisect import bisect_left, bisect_right
from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np


class Message(NamedTuple):
    seq: int  # 0, 1, 2, ... in order of arrival
    arrival_us: int
    size_bytes: int
    x: float  # how far the scene has moved on: the frame's index, or the camera's motion


class Link:
    """C(t), the bytes that the link could have carried by time t: straight between knots, and then from the start."""

    def __init__(self, us: list[int], carried: list[int], offset_us: int = 0) -> None:
        self.us, self.carried, self.offset_us = us, carried, offset_us

    def carried_by(self, t_us: int) -> int:
        """C(t), rounded down: whole bytes and microseconds make a run the same on every machine."""
        laps, t = divmod(t_us + self.offset_us, self.us[-1])
        k = bisect_right(self.us, t) - 1
        span, rise = self.us[k + 1] - self.us[k], self.carried[k + 1] - self.carried[k]
        return laps * self.carried[-1] + self.carried[k] + (t - self.us[k]) * rise // span

    def time_of(self, position: int) -> int:
        """The first whole microsecond with C(t) >= ``position`` > 0; a - (-b) // c is a + b / c rounded up."""
        laps, before = divmod(position - 1, self.carried[-1])
        k = bisect_left(self.carried, before + 1) - 1
        span, rise = self.us[k + 1] - self.us[k], self.carried[k + 1] - self.carried[k]
        return laps * self.us[-1] + self.us[k] - (self.carried[k] - before - 1) * span // rise - self.offset_us


class Sender:
    """A queue of at most L messages, and a socket that sends them one by one. V(d) is what a gap of d in x is worth."""

    def __init__(self, messages: list[Message], link: Link, capacity: int, v: Callable[[float], float]) -> None:
        self.to_come, self.link, self.capacity, self.v = messages[::-1], link, capacity, v
        self.queue, self.dropped = [], []
        self.sent, self.busy = [], False  # all that the socket took; while it is busy the last is in transmission
        self.now_us = self.took_us = self.finish_us = 0  # the clock; when that message was taken, and will have crossed
        self.position, self.previous = 0, messages[0]  # bytes of the link used up by then; the latest arrival
        self.period_us, self.rates = 0.0, [0.0, 0.0, 0.0]  # running means; rates in bytes/us of sending time
        self.carried_us = self.left_bytes = self.out_bytes = self.sending_us = 0
        self.departed = lambda: None  # called when the socket takes a message

    def arrive(self) -> Message | None:
        """Let the link work until the next message arrives; None once all has been sent."""
        newcomer = self.to_come.pop() if self.to_come else None
        while self.busy and self.finish_us <= (newcomer.arrival_us if newcomer else math.inf):
            # What leaves at the very time of an arrival leaves first, and the next follows on the very next byte.
            self.carried_us += self.finish_us - self.took_us
            self.busy, self.now_us = False, self.finish_us
            self.take(self.position)
        if newcomer:
            self.now_us, gap_us = newcomer.arrival_us, newcomer.arrival_us - self.previous.arrival_us
            self.period_us += gap_us if newcomer.seq == 1 else (gap_us - self.period_us) / 8
            self.measure()
        return newcomer

    def measure(self) -> None:
        """Average the link's rate over the sending time since the previous arrival; a socket at rest measures none."""
        busy_us, size = (self.now_us - self.took_us, self.sent[-1].size_bytes) if self.busy else (0, 0)
        self.left_bytes = min(size, max(0, self.position - self.link.carried_by(self.now_us))) if busy_us else size
        out_bytes, sending_us = sum(m.size_bytes for m in self.sent) - self.left_bytes, self.carried_us + busy_us
        gone, us = out_bytes - self.out_bytes, sending_us - self.sending_us
        if us:
            widths = (us + min(window_us, self.sending_us) for window_us in (100_000, 500_000, 2_000_000))
            self.rates = [rate + (gone - rate * us) / width for rate, width in zip(self.rates, widths, strict=True)]
        self.out_bytes, self.sending_us = out_bytes, sending_us

    def decide(self, newcomer: Message, drop: int | None) -> None:
        """Drop a slot (0 is the head, ``len(queue)`` the newcomer) or nothing; then an idle socket takes the head."""
        self.queue.append(newcomer)
        if drop is not None:
            self.dropped.append(self.queue.pop(drop))
        self.previous = newcomer
        if not self.busy:
            self.take(max(self.position, self.link.carried_by(self.now_us)))

    def take(self, position: int) -> None:
        """Let the socket take the head of the queue, if there is one; its first byte goes at ``position``."""
        if self.queue:
            self.sent.append(self.queue.pop(0))
            self.busy, self.took_us = True, self.now_us
            self.position = position + self.sent[-1].size_bytes
            self.finish_us = self.link.time_of(self.position)
            self.departed()

    def gain(self) -> float:
        """The sum of V over the gaps between all that is sent or queued: H - 1 if nothing more is dropped."""
        return sum(self.v(after.x - before.x) for before, after in itertools.pairwise(self.sent + self.queue))


class AFR:
    """Adaptive Frame Rate (Wang et al. 2022) as released: keep one arrival in r, and thin a full queue at p."""

    r, c, p = 1, 0, 0

    def decide(self, s: int, capacity: int) -> int | None:
        """The slot to drop, of s messages queued; s for the newcomer, None for none."""
        if self.r > 1 and s / capacity <= 2 / 3:
            self.r //= 2
        self.c = (self.c + 1) % self.r
        if self.c > 0:
            return s
        if s < capacity:
            return None
        slot, self.p = self.p, self.p + 1
        if self.p >= s:  # the pass is done: every second message has gone
            self.r, self.p = 2 * self.r, 0
        return slot

    def departed(self) -> None:
        self.p = max(0, self.p - 1)  # the head left, so the same message is one slot further to the front

    def play(self, sender: Sender) -> float:
        """Send an episode to its end; return H."""
        sender.departed = self.departed
        while newcomer := sender.arrive():
            sender.decide(newcomer, self.decide(len(sender.queue), sender.capacity))
        return 1 + sender.gain()


class QueueEnv(gym.Env):
    """At a full queue drop the cheapest candidate (0), the second cheapest (1) or the head (2)."""

    action_space, observation_space = gym.spaces.Discrete(3), gym.spaces.Box(-3.0, 3.0, (27,), np.float32)

    def __init__(self, draw: Callable[[np.random.Generator], Sender]) -> None:
        self.draw = draw

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.sender, self.gained = self.draw(self.np_random), 0.0
        return self.next_decision()

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        if self.newcomer:
            self.sender.decide(self.newcomer, self.order[action])
        observation, info = self.next_decision()
        reward, self.gained = self.sender.gain() - self.gained, self.sender.gain()  # adds up to H - 1
        return observation, reward, not self.newcomer, False, info

    def next_decision(self) -> tuple[np.ndarray, dict[str, Any]]:
        """Accept arrivals while there is room; observe the first that finds none, or zeros at the end."""
        while (newcomer := self.sender.arrive()) and len(self.sender.queue) < self.sender.capacity:
            self.sender.decide(newcomer, None)
        self.newcomer, self.order = newcomer, [self.sender.capacity] * 3
        observation = self.observe(newcomer) if newcomer else np.zeros(27)
        return observation.astype(np.float32), {"slots": np.array(self.order)}

    def observe(self, newcomer: Message) -> np.ndarray:
        """Order the candidates by the gap that each would leave, per byte; describe the three, then the queue."""
        sender, waiting, last = self.sender, [*self.sender.queue, newcomer], self.sender.sent[-1]
        s, L, size, step = len(waiting) - 1, sender.capacity, newcomer.size_bytes, newcomer.x - sender.previous.x
        gaps = np.diff([last.x, *(m.x for m in waiting), newcomer.x + step])  # the last step is expected again
        sizes = np.array([m.size_bytes for m in waiting])
        cost = (gaps[:-1] + gaps[1:]) * sizes.mean() / sizes
        self.order = [*np.argsort(cost.round(12), kind="stable")[:2].tolist(), 0]  # of equal gaps the older first
        even, (short, medium, rate), period_us = (newcomer.x - last.x) / (L + 1), sender.rates, max(sender.period_us, 1)
        ratios = [
            *((a[j], b) for a, b in ((cost, 2 * even), (gaps, even), (gaps[1:], even)) for j in self.order),
            (sender.left_bytes, short * period_us), (short, rate), (medium, rate),
            (rate * period_us * math.e**2, size), (step * math.e, even),
            (rate * (newcomer.arrival_us - last.arrival_us), (L + 1) * size),
            (rate * (sender.now_us - sender.took_us), size),
        ]  # fmt: skip
        above, below = np.maximum(np.transpose(ratios), 1e-99)  # so 0 / 0 counts as 1
        logarithms, worth = np.clip(np.log(above / below), -3, 3), sender.v(even)
        bend = min(2 * (2 * worth - sender.v(2 * even)) / worth - 1, 1) if worth > 0 else -1
        flags = [(2 * (j + 1) / (s + 1) - 1, j == s, j == 0) for j in self.order]
        return np.concatenate([np.transpose(flags).ravel(), logarithms, [bend, 2 * s / L - 1]])


def fading(rng: np.random.Generator) -> Sender:
    """60 s of frames over a link whose rate changes every second."""
    frames = [Message(k, k * 33_333, 230_000, float(k)) for k in range(1800)]
    carried = np.cumsum([0, *rng.choice([0, 200_000, 1_000_000, 5_000_000], 60)]).tolist()
    return Sender(frames, Link([s * 1_000_000 for s in range(61)], carried), 8, lambda d: 1 - 0.9**d)


if __name__ == "__main__":
    print(f"AFR: H = {AFR().play(fading(np.random.default_rng(1))):.1f}")
    env = QueueEnv(fading)
    env.reset(seed=1)
    while not env.step(int(env.np_random.integers(3)))[2]:
        pass
    print(f"random actions: H = {1 + env.gained:.1f}")
