"""Links, motions and frame sizes made from a seed; the parameters of the links are fitted to recordings.

trace = markov_link("tram", seed=3)                    # fitted to recordings made in trams
trace = gilbert_elliott(seed=3, mean_bad_s=2)
motion = drive_motion(seed=3)                          # in `synthetic.py`, as `outage`
sizes = frame_sizes(arrival_us, motion, seed=3)
"""

from bufgym.traces.generate.frames import FrameModel, frame_sizes
from bufgym.traces.generate.gilbert_elliott import gilbert_elliott
from bufgym.traces.generate.markov import markov_link
from bufgym.traces.generate.parameters import LinkParameters, OutageParameters, fitted_links, read_links
from bufgym.traces.generate.ramps import ramp, steady, tunnel
from bufgym.traces.generate.roaming import Corridor, roaming

__all__ = [
    "Corridor",
    "FrameModel",
    "LinkParameters",
    "OutageParameters",
    "fitted_links",
    "frame_sizes",
    "gilbert_elliott",
    "markov_link",
    "ramp",
    "read_links",
    "roaming",
    "steady",
    "tunnel",
]
