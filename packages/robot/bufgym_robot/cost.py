"""What a ``PolicyQueue`` costs a robot: a camera's frames at their pace, over a link that is too slow for them.

A frame is handed over as it is, so its bytes cost nothing here. Between two frames a processor's caches forget, the
more the busier it is with other things. So the same is also measured without pauses.
"""

import threading
import time

import numpy as np

from bufgym.cli.options import Positive
from bufgym.utils.tables import Table
from bufgym_robot.wire.queue import PolicyQueue

POLICIES = ("drop-oldest", "afr", "learned")
RATE_HZ, SIZE_BYTES, CAPACITY = 30.0, 230_000, 16  # Frames that the camera puts, and the queue's L
LINK_HZ = 12.0  # Frames a second that the link carries
WITHOUT_PAUSE = 1000  # Frames


def measure(policy: str, seconds: float) -> list[str]:
    """Cells of the table: frames put for so long, then as many as WITHOUT_PAUSE without a pause."""
    queue, body = PolicyQueue(policy, CAPACITY), bytes(SIZE_BYTES)

    def send() -> None:
        for _ in queue:
            time.sleep(1 / LINK_HZ)

    def put() -> float:
        """Time that it took, us."""
        before_ns = time.perf_counter_ns()
        queue.put(body, SIZE_BYTES)
        return (time.perf_counter_ns() - before_ns) / 1e3

    sending = threading.Thread(target=send)
    sending.start()
    put()  # loads what was compiled
    paced_us, held = list[float](), 0
    began_s, began_cpu_s = time.monotonic(), time.process_time()
    for k in range(round(seconds * RATE_HZ)):
        time.sleep(max(0.0, began_s + k / RATE_HZ - time.monotonic()))
        paced_us.append(put())
        held = max(held, len(queue) + queue.in_flight)
    core = (time.process_time() - began_cpu_s) / (time.monotonic() - began_s)
    warm_us = np.median([put() for _ in range(WITHOUT_PAUSE)])
    queue.close()
    sending.join()
    times = [f"{us:.0f} us" for us in (*np.quantile(paced_us, [0.5, 0.99]), warm_us)]
    return [policy, *times, f"{100 * core:.2f} %", str(held)]


def cost(*, seconds: Positive = 20.0) -> None:
    """Print what a live queue costs a robot, policy by policy.

    The share of a core is the whole process's, with both threads and their waiting.

    Args:
        seconds: How long frames come, for each policy.
    """
    about = f"PolicyQueue, L = {CAPACITY}: {SIZE_BYTES} bytes at {RATE_HZ:g} Hz, a link of {LINK_HZ:g} Hz"
    head = ["policy", "put, median", "99 % within", "without pauses", "of a core", "messages held"]
    rows = [measure(policy, seconds) for policy in POLICIES]
    goals = "Goals: 100 us, 1000 us, 5 % of a core."
    print("\n".join([about, "", Table(head, [("", rows)]).markdown(), "", goals]))
