"""Fig. 8 of the AFR paper with a stand-in for tracking: how often a run has a motion gap too long to track across.

The paper runs visual tracking on the frames received and counts the runs that lose it. Here a run fails if the camera
moved by more than ``threshold`` fields of view between two consecutive messages received. At 0.5 half of the last view
is gone, so matching has half of its points left, at the image's far side. At 0.25 ORB-SLAM2 would already want a new
keyframe of an RGB-D camera: NeedNewKeyFrame asks for one under 75 % of the reference keyframe's points tracked. Where
tracking really breaks depends on scene, blur and matcher, so we use three thresholds. A fourth is fitted: there Drop
Oldest fails in half of the runs, as in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bufgym.ground.errors import BufgymError
from bufgym.papers.afr_evaluation import STYLES, StreamFigure
from bufgym.papers.figure import finish, legend_below
from bufgym.papers.rows import Rows
from bufgym.scenario.suites import RATE_HZ

MORE_RUNS = 100
"""Ten runs can tell 0 from 50 %, but not 0 from 10 %. Simulated runs are cheap."""
IDLE = 10.0
"""Failures in % of the runs below which Drop Oldest and Random cannot be told from AFR."""


@dataclass(frozen=True)
class Reproduction(StreamFigure):
    """Failure rates of each policy at each L for each camera; the picture shows the first camera."""

    threshold: float = 0.5
    """Motion gap above which a run fails, fields of view."""
    others: Sequence[float] = (0.25, 0.75)
    """Further thresholds, which show how the result depends on the threshold."""
    more_runs: int = MORE_RUNS
    """Runs of the second count; its first ``runs`` runs are the first count."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.runs > self.more_runs:
            raise BufgymError(f"runs = {self.runs}, more_runs = {self.more_runs}: need 1 <= runs <= more_runs")

    @property
    def thresholds(self) -> list[float]:
        return sorted({self.threshold, *self.others})

    def simulate(self) -> Rows:
        return self.play(self.settings(timed=False), self.more_runs, bound=False)

    def first(self, rows: Rows) -> Rows:
        """Select as many runs as the paper has."""
        return Rows(row for row in rows if row["run"] < self.runs)

    def tables(self, rows: Rows) -> list[str]:
        """List failures in % per camera: all runs by L, and by threshold and frame size."""
        lines: list[str] = []
        for camera in rows.distinct("camera"):
            shown, main = rows.where(camera=camera), rows.where(camera=camera, size_kb=self.size_kb)
            for limit in self.thresholds:
                lines += [f"{camera}, gap above {limit:g} views, by L:", *_failing(main, limit).pivot(*_BY_L), ""]
            lines += [f"{camera}, by the size of a frame in kB:", *_failing(shown, self.threshold).pivot(*_BY_SIZE)]
            half = float(np.median(main.column("longest_gap_views", policy="drop-oldest")))
            others = ", ".join(f"{p} {failures(main, half, policy=p):.1f} %" for p in STYLES if p != "drop-oldest")
            lines += [f"At {half:.2f} Drop Oldest fails in half of the runs, and {others}", ""]
        return lines[:-1]

    def worst(self, rows: Rows, above: int) -> float:
        """Return AFR's failures in % at its worst L > ``above``."""
        rates = (failures(rows, self.threshold, policy="afr", L=L) for L in self.capacities if above < L)
        return max(rates, default=0.0)

    def claims(self, rows: Rows) -> dict[str, Any]:
        """Test the paper's three statements with the first camera; the larger number of runs decides."""
        camera = self.cameras[0].name
        many = rows.where(camera=camera, size_kb=self.size_kb)
        few = self.first(many)
        oldest, random = (failures(many, self.threshold, policy=p) for p in ("drop-oldest", "random"))
        few_oldest, few_random = (failures(few, self.threshold, policy=p) for p in ("drop-oldest", "random"))
        # Where no policy loses track, AFR earns no credit for keeping it.
        tested = max(oldest, random) >= IDLE
        sizes = {kb: rows.where(camera=camera, size_kb=kb) for kb in rows.distinct("size_kb")}
        compared = [
            failures(rows, limit, camera=c, size_kb=kb, policy="afr")
            <= min(failures(rows, limit, camera=c, size_kb=kb, policy=p) for p in ("drop-oldest", "random"))
            for kb, c in rows.distinct("size_kb", "camera")
            for limit in self.thresholds
        ]
        return {
            "oldest": 40 <= oldest <= 60,
            "randoms": 40 <= random <= 60,
            "afr": self.worst(many, 0) < IDLE if tested else None,
            "large": self.worst(many, 10) == 0 if tested else None,
            "about": self.about(),
            "camera": camera,
            "idle": IDLE,
            "oldest_rates": f"{oldest:.0f} % ({few_oldest:.0f} %)",
            "random_rates": f"{random:.0f} % ({few_random:.0f} %)",
            "worst": f"{self.worst(many, 0):.0f} % ({self.worst(few, 0):.0f} %)",
            "worst_large": f"{self.worst(many, 10):.0f} % ({self.worst(few, 10):.0f} %)",
            "swept_oldest": _swept({kb: failures(r, self.threshold, policy="drop-oldest") for kb, r in sizes.items()}),
            "swept_random": _swept({kb: failures(r, self.threshold, policy="random") for kb, r in sizes.items()}),
            "swept_afr": _swept({kb: self.worst(r, 0) for kb, r in sizes.items()}),
            "swept_large": _swept({kb: self.worst(r, 10) for kb, r in sizes.items()}),
            "few": 1 - 0.05 ** (1 / self.runs),
            "many": 1 - 0.05 ** (1 / self.more_runs),
            "ahead": sum(compared),
            "pairs": len(compared),
            "carried": self.share_carried(),
            "slowest": float(self.streamed[1].min()) / (RATE_HZ * self.size_bytes),
        }

    def size_inches(self, rows: Rows) -> tuple[float, float]:
        return 3.6 * len(self.thresholds) + 0.6, 3.6

    def draw(self, rows: Rows, figure: Any) -> None:
        played = rows.where(camera=self.cameras[0].name, size_kb=self.size_kb)
        panels = figure.subplots(1, len(self.thresholds), squeeze=False, sharey=True)[0]
        for axes, limit in zip(panels, self.thresholds, strict=True):
            for policy, (label, colour, marker) in STYLES.items():
                many = [failures(played, limit, policy=policy, L=L) for L in self.capacities]
                axes.plot(self.capacities, many, marker=marker, color=colour, markersize=5, linewidth=1, label=label)
            finish(axes, f"gap above {limit:g} views", ylim=(-4, 104), xlabel="queue size L")
            axes.set_xticks(self.capacities)
        panels[0].set_ylabel("runs that fail, %")
        title = f"{self.cameras[0].name}, {self.size_kb:g} kB, {self.more_runs} runs"
        figure.suptitle(title, fontsize=10)
        legend_below(figure, 5, panels[0])


_BY_L = ("policy", "L", "fails", ".1f")
_BY_SIZE = ("policy", "size_kb", "fails", ".1f")


def _failing(rows: Rows, threshold: float) -> Rows:
    """Add a column with 100 for each run that fails, else 0."""
    return Rows(row | {"fails": 100 * (row["longest_gap_views"] > threshold)} for row in rows)


def _swept(rates: dict[float, float]) -> str:
    return ", ".join(f"{rate:.0f} % at {kb:g} kB" for kb, rate in sorted(rates.items()))


def failures(rows: Rows, threshold: float, **where: object) -> float:
    """Return the percentage of these runs whose longest motion gap exceeds the threshold."""
    return 100 * float((rows.column("longest_gap_views", **where) > threshold).mean())
