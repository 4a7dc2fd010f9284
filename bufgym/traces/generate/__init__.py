"""Links, motions and frame sizes generated from a seed; the parameters of `markov_link` are fitted to recordings.

trace = markov_link("tram", seed=3)                    # fitted to recordings made in trams
trace = gilbert_elliott(seed=3, mean_bad_s=2)
motion = drive_motion(seed=3)
sizes = frame_sizes(arrival_us, motion, seed=3)
"""

from bufgym.traces.generate.driving import Driving, drive_motion
from bufgym.traces.generate.frames import FrameModel, frame_sizes
from bufgym.traces.generate.gilbert_elliott import gilbert_elliott
from bufgym.traces.generate.lte import synthetic_lte
from bufgym.traces.generate.markov import markov_link
from bufgym.traces.generate.parameters import LinkParameters, OutageParameters, fitted_links, read_links
from bufgym.traces.generate.roaming import Corridor, roaming
from bufgym.traces.generate.rules import outage, ramp, steady, tunnel

__all__ = [
    "Corridor",
    "Driving",
    "FrameModel",
    "LinkParameters",
    "OutageParameters",
    "drive_motion",
    "fitted_links",
    "frame_sizes",
    "gilbert_elliott",
    "markov_link",
    "outage",
    "ramp",
    "read_links",
    "roaming",
    "steady",
    "synthetic_lte",
    "tunnel",
]
