"""Runs on real sockets compared with the same runs in the simulator, as numbers and as a file."""

import json
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import combinations, groupby
from pathlib import Path
from typing import Any, Final

from bufgym.oracle.measure import regret
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import write_text
from bufgym.utils.tables import Table

DIFFER: Final = 0.01  # Relative difference in simulated H beyond which two policies should rank alike live


@dataclass(frozen=True)
class LiveRun:
    """One policy on one episode, live and simulated."""

    policy: str
    link: str
    seed: int
    live_delivered: int
    simulated_delivered: int
    live_qoi: float
    simulated_qoi: float
    best_qoi: float  # the clairvoyant's H
    transport: str = "tcp"
    live_s: tuple[float, ...] = ()  # times from a message's arrival at the queue to its receipt, in order of receipt
    simulated_s: tuple[float, ...] = ()

    @property
    def live_regret(self) -> float:
        return regret(self.live_qoi, self.best_qoi)

    @property
    def simulated_regret(self) -> float:
        return regret(self.simulated_qoi, self.best_qoi)

    @property
    def live_median_s(self) -> float:
        """Median delivery time."""
        return statistics.median(self.live_s) if self.live_s else 0.0

    @property
    def simulated_median_s(self) -> float:
        return statistics.median(self.simulated_s) if self.simulated_s else 0.0


def by_policy(runs: Sequence[LiveRun]) -> dict[str, list[LiveRun]]:
    """Group the runs by policy, the best in the simulator first."""
    found: dict[str, list[LiveRun]] = {}
    for one in runs:
        found.setdefault(one.policy, []).append(one)
    return dict(sorted(found.items(), key=lambda entry: -mean("simulated_qoi", entry[1])))


def mean(name: str, runs: Sequence[LiveRun]) -> float:
    """Mean of a field over the runs."""
    return statistics.fmean(getattr(one, name) for one in runs)


def orders(runs: Sequence[LiveRun]) -> tuple[int, int]:
    """Count pairs of policies whose simulated H on an episode differ by over ``DIFFER``: in the same order live,
    all."""

    def episode(one: LiveRun) -> tuple[str, str, int]:
        return one.transport, one.link, one.seed

    same = pairs = 0
    for _, group in groupby(sorted(runs, key=episode), key=episode):
        for one, other in combinations(group, 2):
            low, high = sorted((one, other), key=lambda run: run.simulated_qoi)
            if high.simulated_qoi > (1 + DIFFER) * low.simulated_qoi:
                pairs += 1
                same += high.live_qoi > low.live_qoi
    return same, pairs


def agreement(runs: Sequence[LiveRun]) -> str:
    """Summarize the difference of live and simulated in one line."""
    apart = [abs(one.live_qoi / one.simulated_qoi - 1) if one.simulated_qoi else 0.0 for one in runs]
    counts = [abs(one.live_delivered - one.simulated_delivered) for one in runs]
    same, pairs = orders(runs)
    return (
        f"{len(runs)} runs: QoI live and simulated {statistics.median(apart):.2%} apart (median), "
        f"{max(apart):.2%} at most; delivered {statistics.median(counts):g} and {max(counts)}. "
        f"Of {pairs} pairs of policies that differ by more than {DIFFER:.0%}, {same} stand in the same order."
    )


COLUMNS: Final = (
    ("delivered", "delivered", "{:.1f}"),
    ("QoI", "qoi", "{:.3f}"),
    ("regret", "regret", "{:.2%}"),
    ("median delivery, s", "median_s", "{:.3f}"),
)
"""Title, field of a run and format; each column is shown live and simulated."""
SIDES: Final = ("live", "simulated")


def table(runs: Sequence[LiveRun]) -> str:
    """Write the runs as Markdown: means by policy, then the difference of live and simulated."""
    head = ["policy", *(f"{title}{side}" for title, _, _ in COLUMNS for side in (", live", ""))]
    head[2::2] = ["simulated"] * len(COLUMNS)
    lines = [
        [name, *(form.format(mean(f"{side}_{key}", chosen)) for _, key, form in COLUMNS for side in SIDES)]
        for name, chosen in by_policy(runs).items()
    ]
    return "\n".join([Table(head, [("", lines)]).markdown(), "", agreement(runs)])


def save(runs: Sequence[LiveRun], about: str, command: str, folder: Path) -> Path:
    """Write ``runs.json`` with all runs, delivery times, settings and the command; return its path."""
    target = folder / "runs.json"
    kept: dict[str, Any] = {"about": about, "command": command, "runs": [asdict(one) for one in runs]}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_text(target, json.dumps(kept))
    except OSError as error:
        raise BufgymError(f"{target}: {error.strerror or error}") from None
    return target
