"""The link and the stream of ``ros1/fade.py`` and ``ros2/fade.py``, and what the simulator makes of them.

24 Mbit/s, and 2 Mbit/s for a quarter of the time, in the middle; frames of 230 kB at 30 Hz, a queue of 15.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.scenario import Episode, messages
from bufgym.sim import run
from bufgym.sim.metrics import outcome
from bufgym.traces import Trace

RATE_HZ, SIZE_BYTES, QUEUE_SIZE = 30.0, 230_000, 15
FAST, SLOW = 3_000_000, 250_000
"""Bytes a second."""
V = qoi.exponential(0.618)
HEADINGS = """\
| queue | delivered | QoI | longest gap | in the simulator: delivered | QoI | longest gap |
|---|---:|---:|---:|---:|---:|---:|"""


def fade(seconds: float) -> Trace:
    """The link: slow from 3/8 to 5/8 of the time."""
    times = seconds * np.array([0, 3, 5, 8]) / 8
    carried = np.append(0, np.cumsum(np.diff(times) * [FAST, SLOW, FAST]))
    return Trace("fade", np.rint(times * 1e6).astype(np.int64), np.rint(carried).astype(np.int64), "hold")


def arrived(frames: Sequence[int]) -> dict[str, Any]:
    """What a run is measured by; ``frames``: the numbers of those that came."""
    gaps = np.diff(sorted(frames))
    return {
        "delivered": len(frames),
        "qoi": round(V.information(sorted(frames)), 2),
        "longest_gap": int(gaps.max(initial=0)),
    }


def simulated(policy: str, seconds: float) -> dict[str, Any]:
    """The same in the simulator."""
    times = np.arange(round(seconds * RATE_HZ)) * round(1e6 / RATE_HZ)
    episode = Episode(messages(times, SIZE_BYTES), Link(fade(seconds)))
    stats = outcome(run(policies.get(policy), [episode], QUEUE_SIZE, V), 0)
    return {"delivered": stats.delivered, "qoi": round(stats.qoi, 2), "longest_gap": int(stats.longest_gap)}


def line(name: str, *rows: dict[str, Any] | None) -> str:
    """A line of the table."""
    keys = ("delivered", "qoi", "longest_gap")
    cells = [f"{row[key]:g}" if row else "" for row in rows for key in keys]
    return f"| {name} | {' | '.join(cells)} |"
