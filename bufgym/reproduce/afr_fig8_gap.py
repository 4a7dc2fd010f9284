"""Fig. 8 of the AFR paper, by a stand-in for tracking: how often a run has a motion gap too long to track across.

The paper runs visual tracking on the frames received and counts the runs that lose it. Here a run fails if, between two
messages received one after the other, the camera moved on by more than ``threshold`` fields of view. At 0.5 half of the
last view is gone: matching has half of its points left, at the image's far side. At 0.25 ORB-SLAM2 would already want a
new keyframe of an RGB-D camera (NeedNewKeyFrame: under 75 % of the reference keyframe's points tracked). Where tracking
really breaks depends on scene, blur and matcher, hence three thresholds, and one that knows none of it: the threshold
at which Drop Oldest fails in half of the runs, as it does in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bufgym.errors import BufgymError
from bufgym.reproduce.afr_evaluation import STYLES, StreamFigure
from bufgym.reproduce.figure import finish, legend_below, several
from bufgym.reproduce.rows import Rows, table
from bufgym.scenario.checks import above_0
from bufgym.scenario.suites import RATE_HZ

MORE_RUNS = 100
"""Ten runs tell 0 from 50 %, not 0 from 10 %; simulated ones are cheap."""
IDLE = 10.0
"""Percent of the runs: where Drop Oldest and Random fail less often, AFR cannot be told from them."""


@dataclass(frozen=True)
class Reproduction(StreamFigure):
    """Failure rates of each policy at each L, over each link and camera; the picture shows the first camera."""

    threshold: float = 0.5
    """Motion gap above which a run fails, fields of view."""
    others: Sequence[float] = (0.25, 0.75)
    """Further thresholds, to see what depends on it."""
    more_runs: int = MORE_RUNS
    """Runs of the second count, of which the first ``runs`` are the first."""

    RULES = {"threshold": above_0, "others": several(above_0)}

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
        """The paper's number of runs."""
        return Rows(row for row in rows if row["run"] < self.runs)

    def tables(self, rows: Rows) -> list[str]:
        """Failures in % in each setting: of the first runs at each L, and of all runs at each threshold."""
        lines: list[str] = []
        for setting in rows.distinct("setting"):
            played = rows.where(setting=setting)
            few, half = self.first(played), float(np.median(played.column("longest_gap_views", policy="drop-oldest")))
            cells = [["L", *map(str, self.capacities), "|", *(f"> {limit:g}" for limit in self.thresholds)]]
            for policy in STYLES:
                rates = [f"{failures(few, self.threshold, policy=policy, L=L):.0f}" for L in self.capacities]
                many = [f"{failures(played, limit, policy=policy):.1f}" for limit in self.thresholds]
                cells.append([policy, *rates, "|", *many])
            others = ", ".join(f"{p} {failures(played, half, policy=p):.1f} %" for p in STYLES if p != "drop-oldest")
            lines += [setting, *table(cells), f"At {half:.2f} Drop Oldest fails in half of the runs, and {others}", ""]
        return lines[:-1]

    def worst(self, rows: Rows, above: int) -> float:
        """AFR's failures in % at its worst L > ``above``."""
        rates = (failures(rows, self.threshold, policy="afr", L=L) for L in self.capacities if above < L)
        return max(rates, default=0.0)

    def claims(self, rows: Rows) -> dict[str, Any]:
        """The paper's three statements in each setting; the larger number of runs decides."""
        verdicts: dict[str, list[bool | None]] = {"others": [], "afr": [], "large": []}
        texts: dict[str, list[str]] = {"others": [], "afr": [], "large": []}
        for setting in rows.distinct("setting"):
            many = rows.where(setting=setting)
            few = self.first(many)
            rates, few_rates = (
                [failures(played, self.threshold, policy=policy) for policy in ("drop-oldest", "random")]
                for played in (many, few)
            )
            # Where nobody loses track, AFR earns no credit for keeping it.
            tested = max(rates) >= IDLE
            verdicts["others"].append(all(40 <= rate <= 60 for rate in rates))
            texts["others"].append(f"{setting} {rates[0]:.0f}, {rates[1]:.0f} ({few_rates[0]:.0f}, {few_rates[1]:.0f})")
            for key, above in (("afr", 0), ("large", 10)):
                worst = self.worst(many, above)
                verdicts[key].append((worst < IDLE if above == 0 else worst == 0) if tested else None)
                texts[key].append(f"{setting} {worst:.0f} ({self.worst(few, above):.0f}){'' if tested else ' no test'}")
        compared = [
            failures(rows, limit, setting=setting, policy="afr")
            <= min(failures(rows, limit, setting=setting, policy=p) for p in ("drop-oldest", "random"))
            for setting in rows.distinct("setting")
            for limit in self.thresholds
        ]
        slowest = float(self.streamed[1].min()) / (RATE_HZ * self.size_bytes)
        links = rows.where(camera=self.cameras[0].name).distinct("setting", "link_scale")
        return {
            **{key: None if set(tests) == {None} else False not in tests for key, tests in verdicts.items()},
            "about": self.about(),
            "idle": IDLE,
            "others_text": "; ".join(texts["others"]),
            "worst": "; ".join(texts["afr"]),
            "worst_large": "; ".join(texts["large"]),
            "few": 1 - 0.05 ** (1 / self.runs),
            "many": 1 - 0.05 ** (1 / self.more_runs),
            "ahead": sum(compared),
            "pairs": len(compared),
            "carried": "; ".join(
                f"{setting.partition(', link ')[2]}: {self.share_carried(scale):.0%}, in the slowest second "
                f"{slowest * scale:.0%}"
                for setting, scale in links
            ),
        }

    def size_inches(self, rows: Rows) -> tuple[float, float]:
        links = len(rows.distinct("link_scale"))
        return 3.6 * len(self.thresholds) + 0.6, 2.6 * links + 1.0

    def draw(self, rows: Rows, figure: Any) -> None:
        camera = self.cameras[0].name
        settings = rows.where(camera=camera).distinct("setting")
        grid = figure.subplots(len(settings), len(self.thresholds), squeeze=False, sharex=True, sharey=True)
        ticks = np.arange(len(self.capacities))
        for line, setting in zip(grid, settings, strict=True):
            played = rows.where(setting=setting)
            for axes, limit in zip(line, self.thresholds, strict=True):
                for k, (policy, (label, colour, marker)) in enumerate(STYLES.items()):
                    few, many = (
                        [failures(some, limit, policy=policy, L=L) for L in self.capacities]
                        for some in (self.first(played), played)
                    )
                    # Marks stand side by side, so that equal rates stay visible.
                    aside = ticks + 0.09 * (k - (len(STYLES) - 1) / 2)
                    axes.plot(aside, few, marker, color=colour, markersize=5, label=label)
                    axes.plot(ticks, many, color=colour, linewidth=1)
                axes.set_xticks(ticks, [str(L) for L in self.capacities])
                finish(axes, f"link {setting.partition(', link ')[2]}, threshold {limit:g}", ylim=(-4, 104))
            line[0].set_ylabel("runs that fail, %")
        for axes in grid[-1]:
            axes.set_xlabel("queue size L")
        figure.suptitle(f"{camera}: marks {self.runs} runs, lines {self.more_runs} runs", fontsize=10)
        legend_below(figure, 5, grid[0, 0])


def failures(rows: Rows, threshold: float, **where: object) -> float:
    """Percent of these runs whose longest motion gap exceeds the threshold."""
    return 100 * float((rows.column("longest_gap_views", **where) > threshold).mean())
