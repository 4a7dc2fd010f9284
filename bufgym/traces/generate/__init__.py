"""Links and motions generated from a seed; the parameters of `markov_link` are fitted to recordings.

trace = markov_link("tram", seed=3)                    # fitted to recordings made in trams
motion = drive_motion(seed=3)
"""

from bufgym.traces.generate.driving import drive_motion
from bufgym.traces.generate.lte import synthetic_lte
from bufgym.traces.generate.markov import markov_link
from bufgym.traces.generate.parameters import LinkParameters, OutageParameters, fitted_links, read_links
from bufgym.traces.generate.rules import ramp, steady, tunnel

__all__ = [
    "LinkParameters", "OutageParameters", "drive_motion", "fitted_links", "markov_link", "ramp", "read_links", "steady",
    "synthetic_lte", "tunnel",
]  # fmt: skip
