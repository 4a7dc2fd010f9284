"""What a ``PolicyQueue`` costs a robot: a camera's frames at its pace, over a link that is too slow for them.

A frame is handed over as it is, so its bytes cost nothing here. Between two frames the caches forget: a loop that puts
without a pause would say less than a robot sees.
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
GOALS = (100.0, 1000.0, 5.0)
"""Of put's median and 99th percentile, us, and of the share of a core, %."""


@dataclass(frozen=True)
class Cost:
    """Of one policy's queue."""

    policy: str
    median_us: float
    """Of the time in ``put``."""
    p99_us: float
    cpu_us: float
    """Median of the CPU time in ``put``: without what others on the machine took."""
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
    took: list[tuple[int, int]] = []
    held = 0
    began_s = time.monotonic()
    began_cpu_s = time.process_time()
    for k in range(round(seconds * RATE_HZ)):
        time.sleep(max(0.0, began_s + k / RATE_HZ - time.monotonic()))
        before = time.perf_counter_ns(), time.thread_time_ns()
        queue.put(body, SIZE_BYTES)
        took.append((time.perf_counter_ns() - before[0], time.thread_time_ns() - before[1]))
        held = max(held, len(queue) + queue.in_flight)
    cpu_s, went_by_s = time.process_time() - began_cpu_s, time.monotonic() - began_s
    queue.close()
    sending.join()
    wall_us, cpu_us = np.array(took[1:]).T / 1e3  # the first one loads what was compiled
    median, p99 = np.quantile(wall_us, [0.5, 0.99]).tolist()
    return Cost(policy, median, p99, float(np.median(cpu_us)), 100 * cpu_s / went_by_s, held)


def report(costs: list[Cost]) -> str:
    """A table, then what it is."""
    lines = [
        f"PolicyQueue, L = {CAPACITY}: {SIZE_BYTES} bytes at {RATE_HZ:g} Hz, a link of {LINK_HZ:g} Hz",
        "",
        "| policy | put, median | 99 % within | CPU time | of a core | messages held |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for cost in costs:
        times = " | ".join(f"{us:.0f} us" for us in (cost.median_us, cost.p99_us, cost.cpu_us))
        lines.append(f"| {cost.policy} | {times} | {cost.core_percent:.2f} % | {cost.held} |")
    median, p99, core = GOALS
    lines += ["", f"Goals: {median:g} us, {p99:g} us, {core:g} % of a core."]
    return "\n".join(lines)
