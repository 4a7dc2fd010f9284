"""The AFR paper's own evaluation (Sec. V): 794 frames at 30 Hz over the Belgium 4G log car_0002, L = 5, 10, 15, ...

The paper gives no size of a frame. About 160 kB is our fit: it reproduces about 400 recalculations (Sec. V-D) and 8 Hz
around the seconds 21 and 23 at L = 5 (Sec. V-B); see ``bufgym reproduce afr-frame-size``.
"""

import os
from dataclasses import replace
from pathlib import Path

from bufgym.model import qoi
from bufgym.scenario.uplink import Uplink
from bufgym.traces import Trace, read_trace

RATE_HZ = 30.0
PAPER_FRAMES = 794
FRAME_BYTES = 160_000
LINK = "belgium_4g/csv/report_car_0002.csv"  # The log, in a folder of recordings
FOLDER = "BUFGYM_DATA"
"""Environment variable that names the folder for the scenario ``afr-evaluation``."""


def fade() -> Trace:
    """Stand-in for car_0002: 2.2 MB/s, about its mean, and 0.4 MB/s from second 21 to second 24."""
    return Trace.steps([(21, 2.2e6), (3, 0.4e6), (30, 2.2e6)], name="car_0002-stand-in")


def evaluation(*links: Trace) -> Uplink:
    """The stream over these links from their start; V is the one in the paper's Fig. 5."""
    stream = Uplink(links, rate_hz=RATE_HZ, size_bytes=FRAME_BYTES, random_offset=False)
    return replace(stream, duration_s=PAPER_FRAMES / RATE_HZ, value=qoi.exponential(0.618))


def afr_evaluation() -> Uplink:
    """Over car_0002 where the folder of recordings is named and has it, else over the stand-in."""
    path = Path(os.environ.get(FOLDER, ""), LINK)
    return evaluation(read_trace(path) if path.is_file() else fade())
