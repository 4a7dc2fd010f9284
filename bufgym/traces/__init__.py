"""Bandwidth traces, motion recordings and workloads: from files, into files, or generated from a seed.

trace = load("lte-synthetic-3")            # shipped with bufgym
trace = read_trace("TMobile-LTE-short.up.gz")
trace = Trace.steps([(5, 8e6), (2, 0)])    # 5 s at 8 MB/s, 2 s of nothing
trace = markov_link("tram", seed=3)        # as recorded in trams
motion = read_motion("freiburg1_desk.groundtruth.txt.gz")
workload = read_workload("drive.mcap", topics=["/camera/*"], odom="/odom")

An argument out of its range raises a BufgymError. A file that cannot be read or written, or that breaks a rule of its
format, raises its subclass TraceError, whose message names the file, the line, the value and the rule.
"""

from typing import TYPE_CHECKING

from bufgym.traces.motion import Motion, MotionSettings, motion_from_poses
from bufgym.traces.poses import Poses
from bufgym.traces.shipped import load, load_motion, shipped
from bufgym.traces.trace import Trace, describe
from bufgym.traces.workload import Workload
from bufgym.utils.modules import on_demand

if TYPE_CHECKING:
    from bufgym.traces.formats.bags import read_bag
    from bufgym.traces.formats.links import FORMATS, detect_format, read_trace
    from bufgym.traces.formats.motions import read_motion, write_motion_csv
    from bufgym.traces.formats.recordings import read_workload, workload_from_bag
    from bufgym.traces.formats.tables import Columns
    from bufgym.traces.formats.workloads import read_workload_csv, write_workload_csv
    from bufgym.traces.formats.writers import WRITERS, difference, write_csv, write_mahimahi
    from bufgym.traces.generate.driving import drive_motion
    from bufgym.traces.generate.lte import synthetic_lte
    from bufgym.traces.generate.markov import markov_link
    from bufgym.traces.generate.parameters import read_links
    from bufgym.traces.generate.rules import ramp, steady, tunnel

__all__ = ["Trace", "Workload", "load", "read_workload"]

__getattr__ = on_demand(__name__, {
    "Columns": "formats.tables", "read_bag": "formats.bags", "FORMATS": "formats.links",
    "detect_format": "formats.links", "read_trace": "formats.links", "read_motion": "formats.motions",
    "write_motion_csv": "formats.motions", "read_workload": "formats.recordings",
    "workload_from_bag": "formats.recordings", "read_workload_csv": "formats.workloads",
    "write_workload_csv": "formats.workloads", "WRITERS": "formats.writers", "difference": "formats.writers",
    "write_csv": "formats.writers", "write_mahimahi": "formats.writers", "drive_motion": "generate.driving",
    "synthetic_lte": "generate.lte", "markov_link": "generate.markov", "read_links": "generate.parameters",
    "ramp": "generate.rules", "steady": "generate.rules", "tunnel": "generate.rules",
})  # fmt: skip


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
