"""What a ``PolicyQueue`` costs a robot: a camera's frames at its pace, over a link that is too slow for them.

A frame is handed over as it is, so its bytes cost nothing here. Between two frames a processor's caches forget, the
more the busier it is with other things: so the same is also measured without pauses.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import numpy as np

from bufgym.live import PolicyQueue

POLICIES = ("drop-oldest", "afr", "learned-motion")
RATE_HZ, SIZE_BYTES, CAPACITY = 30.0, 230_000, 16
LINK_HZ = 12.0
"""Frames a second that the link carries."""
_WITHOUT_PAUSE = 1000
"""Frames."""
GOALS = (100.0, 1000.0, 5.0)
"""Of put's median and 99th percentile, us, and of the share of a core, %."""


@dataclass(frozen=True)
class Cost:
    """Of one policy's queue."""

    policy: str
    median_us: float
    """Of the time in ``put``."""
    p99_us: float
    warm_us: float
    """The median of frames that come without a pause."""
    core_percent: float
    """CPU time of the whole process, both threads and their waiting included, over the time that went by."""
    held: int
    """Messages in the queue and in the socket at a time, at most."""


def measure(policy: str, seconds: float) -> Cost:
    """Put frames for so long."""
    queue, body = PolicyQueue(policy, CAPACITY), bytes(SIZE_BYTES)

    def send() -> None:
        for _ in queue:
            time.sleep(1 / LINK_HZ)

    sending = threading.Thread(target=send)
    sending.start()
    took_us: list[float] = []
    held = 0

    def put() -> None:
        before_ns = time.perf_counter_ns()
        queue.put(body, SIZE_BYTES)
        took_us.append((time.perf_counter_ns() - before_ns) / 1e3)

    put()  # loads what was compiled
    took_us.clear()
    began_s, began_cpu_s = time.monotonic(), time.process_time()
    for k in range(round(seconds * RATE_HZ)):
        time.sleep(max(0.0, began_s + k / RATE_HZ - time.monotonic()))
        put()
        held = max(held, len(queue) + queue.in_flight)
    cpu_s, went_by_s = time.process_time() - began_cpu_s, time.monotonic() - began_s
    median, p99 = np.quantile(took_us, [0.5, 0.99]).tolist()
    took_us.clear()
    for _ in range(_WITHOUT_PAUSE):
        put()
    queue.close()
    sending.join()
    return Cost(policy, median, p99, float(np.median(took_us)), 100 * cpu_s / went_by_s, held)


def report(costs: list[Cost]) -> str:
    """A table, then what it is."""
    lines = [
        f"PolicyQueue, L = {CAPACITY}: {SIZE_BYTES} bytes at {RATE_HZ:g} Hz, a link of {LINK_HZ:g} Hz",
        "",
        "| policy | put, median | 99 % within | without pauses | of a core | messages held |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for cost in costs:
        times = " | ".join(f"{us:.0f} us" for us in (cost.median_us, cost.p99_us, cost.warm_us))
        lines.append(f"| {cost.policy} | {times} | {cost.core_percent:.2f} % | {cost.held} |")
    median, p99, core = GOALS
    lines += ["", f"Goals: {median:g} us, {p99:g} us, {core:g} % of a core."]
    return "\n".join(lines)
