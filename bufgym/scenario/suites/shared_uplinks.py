"""Suites in which several streams share an uplink: the topics of one client, the robots of one cell."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from bufgym.scenario.client import Client, robofleet_example
from bufgym.scenario.fleet import FleetScenario
from bufgym.scenario.suites import synthetic
from bufgym.scenario.suites.suite import Setting, Suite
from bufgym.scenario.suites.synthetic import EPISODE_S, FIRST_SEED, TRACES, lte_links, motions_of
from bufgym.traces import Trace

_DROPOUT_S = (3.0, 20.0)
_BETWEEN_DROPOUTS_S = 45.0


def _with_dropouts(trace: Trace, seed: int) -> Trace:
    """The same link with dropouts of 3 to 20 s, one in 45 s on average."""
    rng = np.random.default_rng(seed)
    lengths_us, rates = trace.samples()
    steps: list[tuple[float, float]] = []
    left_s = float(rng.exponential(_BETWEEN_DROPOUTS_S))
    for us, rate in zip(lengths_us, rates, strict=True):
        steps.append((float(us) / 1e6, float(rate)))
        left_s -= float(us) / 1e6
        if left_s <= 0:
            steps.append((float(np.exp(rng.uniform(*np.log(_DROPOUT_S)))), 0.0))
            left_s = float(rng.exponential(_BETWEEN_DROPOUTS_S))
    return Trace.steps(steps, name=f"{trace.name}-dropouts")


CLIENT_MEANS = {"scarce": 0.5e6, "half": 1.2e6, "ample": 2.5e6}
"""Bytes/s of the link while it is up. The example client wants 2.8 MB/s after rate limits."""
CLIENT_WINDOWS = {"": 1, "-window-5": 5}
"""n_T in Robofleet's experiments, where an ack may take longer than a message, and in its released client."""


def _topics(split: str, data: Path) -> dict[str, Setting]:
    """Robofleet's example client over LTE links with dropouts, at three mean capacities and two n_T."""
    settings = {}
    for number, (label, mean) in enumerate(CLIENT_MEANS.items()):
        first = FIRST_SEED[split] + 100 * number
        links = [_with_dropouts(t, first + k) for k, t in enumerate(lte_links(first, TRACES[split] // 2, (mean,)))]
        client = Client(robofleet_example(), tuple(links), motions_of(split), duration_s=EPISODE_S)
        for suffix, window in CLIENT_WINDOWS.items():
            about = f"Robofleet's example client over LTE with dropouts, {mean / 1e6:g} MB/s, n_T = {window}"
            settings[label + suffix] = Setting(replace(client, window=window), about)
    return settings


def _fleet(split: str, data: Path) -> dict[str, Setting]:
    """The motion setting of lte-v1 for 16 robots: the cell has 16 times that capacity."""
    alone = synthetic.LTE.settings(split)["motion"]
    about = f"{alone.about}, of each robot"
    return {"motion": Setting(FleetScenario(16, alone.scenario), about)}


SUITES = (
    Suite("topics-v1", "Robofleet's example client, 8 topics, over LTE with dropouts", _topics, (32,), kind="topics"),
    Suite(
        "fleet-v1",
        "16 robots share a cell; 30 Hz camera over synthetic LTE links, x is each camera's motion",
        _fleet,
        capacities=(5, 10, 20),
        kind="fleet",
    ),
)
