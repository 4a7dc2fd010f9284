"""jpeg-v1: messages as cameras send them, of unequal sizes by five laws, over links that carry one in 3 to 17.

Equal sizes are the control: a rule that sees no bytes is at its best there. Each law meets the same links and the same
motion at two loads, once with L messages and once with room for the bytes of eight.
"""

from pathlib import Path

from bufgym.model import qoi
from bufgym.scenario.suites.suite import Setting, Suite
from bufgym.scenario.suites.synthetic import EPISODE_S, FIRST_SEED, RATE_HZ, SIZE_BYTES, motions_of
from bufgym.scenario.uplink import Uplink
from bufgym.traces import synthetic_lte
from bufgym.traces.generate.lte import LTE_MODES

LAWS = ("jpeg", "gop", "depth-colour", "motion", "equal")
MEANS = {"heavy": (0.4e6, 0.5e6, 0.6e6), "light": (0.9e6, 1.2e6, 1.6e6, 2e6)}
"""Mean rates of the links, bytes/s, in turn; the demand is 6.9 MB/s."""
LINKS = {"train": 12, "validation": 6, "test": 24}
"""Links of a split at each of the two loads."""
PLACES, MANY = 8, 31
"""Mean messages that the byte limit has room for, and L there."""


def _cameras(split: str, data: Path | None) -> dict[str, Setting]:
    settings, modes, first = {}, list(LTE_MODES), FIRST_SEED[split]
    for load, means in MEANS.items():
        seeds = (
            range(first, first + LINKS[split]) if load == "heavy" else range(first + 500, first + 500 + LINKS[split])
        )
        traces = tuple(
            synthetic_lte(seed, mean_bytes_per_s=means[k % len(means)], mode=modes[k % 3])
            for k, seed in enumerate(seeds)
        )
        for law in LAWS:
            scenario = Uplink(
                traces=traces,
                motion=motions_of(split, 8),
                rate_hz=RATE_HZ,
                size_bytes=SIZE_BYTES,
                sizes=law,
                duration_s=EPISODE_S,
                value=qoi.exponential(0.05),
            )
            about = f"sizes of the law {law}, mean 230 kB, 30 Hz; {load} load; x is the camera's motion"
            settings[f"{law}-{load}"] = Setting(scenario, about)
            room = f"{about}; room for {PLACES} mean messages' bytes"
            settings[f"{law}-{load}-bytes"] = Setting(scenario, room, max_bytes=PLACES * SIZE_BYTES, capacities=(MANY,))
    return settings


SUITES = (
    Suite(
        "jpeg-v1",
        "messages of unequal sizes as cameras send them, over synthetic LTE links",
        _cameras,
        capacities=(8, 15),
        seeds=1,
    ),
)
