"""Bandwidth traces and motion recordings: in from files, out to files, or made up from a seed.

trace = load("lte-synthetic-3")            # shipped with bufgym
trace = read_trace("TMobile-LTE-short.up.gz")
trace = Trace.steps([(5, 8e6), (2, 0)])    # 5 s at 8 MB/s, 2 s of nothing
motion = read_motion("freiburg1_desk.groundtruth.txt.gz")
"""

from bufgym.traces.archives import members
from bufgym.traces.motion import Motion, motion_from_poses, read_motion, write_motion_csv
from bufgym.traces.readers import FORMATS, detect_format, read_trace
from bufgym.traces.shipped import load, load_motion, shipped
from bufgym.traces.synthetic import drive_motion, outage, synthetic_lte
from bufgym.traces.trace import Trace, describe
from bufgym.traces.writers import WRITERS, Difference, difference, write_csv, write_mahimahi

__all__ = [
    "FORMATS",
    "WRITERS",
    "Difference",
    "Motion",
    "Trace",
    "describe",
    "detect_format",
    "difference",
    "drive_motion",
    "load",
    "load_motion",
    "members",
    "motion_from_poses",
    "outage",
    "read_motion",
    "read_trace",
    "shipped",
    "synthetic_lte",
    "write_csv",
    "write_mahimahi",
    "write_motion_csv",
]
