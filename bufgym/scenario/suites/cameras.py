"""jpeg-v1: messages as cameras send them, of unequal sizes by five laws, over links that carry one in 3 to 17.

Equal sizes are the control: a rule that sees no bytes is at its best there. Each law meets the same links and the same
motion at two loads, once with L messages and once with room for the bytes of eight.
"""

from pathlib import Path

from bufgym.model import qoi
from bufgym.scenario.suites.suite import Setting, Suite
from bufgym.scenario.suites.synthetic import FIRST_SEED, SIZE_BYTES, camera, lte_links, motions_of

LAWS = ("jpeg", "gop", "depth-colour", "motion", "equal")
MEANS = {"heavy": (0.4e6, 0.5e6, 0.6e6), "light": (0.9e6, 1.2e6, 1.6e6, 2e6)}
"""Mean rates of the links, bytes/s, in turn; the demand is 6.9 MB/s."""
LINKS = {"train": 12, "validation": 6, "test": 24}  # Links of a split at each of the two loads
PLACES, MANY = 8, 31  # Mean messages that the byte limit has room for, and L there


def _cameras(split: str, data: Path) -> dict[str, Setting]:
    settings = {}
    for k, (load, means) in enumerate(MEANS.items()):
        traces = lte_links(FIRST_SEED[split] + 500 * k, LINKS[split], means)
        for law in LAWS:
            scenario = camera(traces=traces, motion=motions_of(split, 8), sizes=law, value=qoi.exponential(0.05))
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
