"""Quantity of Information against the robot's task: which V best predicts the map's quality and lost tracking?

Every run of Fig. 7 and 8 has its coverage and its information by time, by motion and by measured overlap. It also has
the error of the map, the missing part of the map, and whether tracking broke. Correlation is Spearman's over the runs
of a recording, and the bootstrap draws whole offsets of the fade. *Within* compares only runs of the same queue size
and offset. It asks whether V tells policies apart; otherwise a correlation may only show that a larger queue is better.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.benchmark.bootstrap import Interval, interval, stream
from bufgym.benchmark.rows import Row
from bufgym.benchmark.table import NONE
from bufgym.scenario.suites import motion_value, time_value
from bufgym.utils.tables import aligned
from bufgym_papers.figures.figure import COLOURS, finish, legend_below
from bufgym_papers.figures.frame_runs import POLICIES, RESAMPLES, FrameFigure, FrameRun, spearman
from bufgym_papers.figures.rows import FigureRows, listed
from bufgym_papers.perception import views
from studies.afr_overlap import overlap_information

MEASURES = {
    "H_time": "time",
    "H_motion": "motion",
    "H_overlap": "overlap",
    "coverage": "coverage",
    "least_overlap": "least overlap",
}
"""Column -> name of the measure. The last measure is the minimum over all steps; the others are sums."""
TASKS = {
    "rmse_mm": "map error",
    "uncovered": "map's holes",
    "failed": "tracking failure",
    "slam_rmse_mm": "error with tracked poses",
}
"""Column -> name of a harm to the robot; a good measure falls where the harm grows."""
ACROSS, WITHIN = "all runs", "within"


@dataclass(frozen=True)
class Reproduction(FrameFigure):
    """Correlation of each measure of information with each measure of the task, on each recording."""

    @cached_property
    def runs(self) -> FigureRows:
        """The runs of Fig. 7 and 8, each with its information by each measure."""
        played = zip(self.settings(), self.play("map", "track"), strict=True)
        return FigureRows(row | self.information(setting) for setting, row in played)

    def information(self, setting: FrameRun) -> Row:
        """Compute H of the run's frames by time, motion and measured overlap, and their coverage of the scene."""
        kept, on = self.kept(setting), self.stage(setting.recording)
        x = on.episode(self.link, 0).arrivals["x"][list(kept)]
        return {
            "H_time": time_value().information(np.array(kept, np.float64)),
            "H_motion": motion_value().information(x),
            "H_overlap": overlap_information(on.seen, kept),
            "least_overlap": views.least_overlap(on.seen, kept),
            "coverage": on.coverage.share(kept),
        }

    def simulate(self) -> FigureRows:
        """Return a row for each recording, measure and task."""
        rows = FigureRows()
        for recording in self.recordings:
            shown = self.runs.where(recording=recording)
            offset = np.array(shown.column("k"), np.int64)
            cell = [(row["k"], row["L"]) for row in shown]
            for scope, measure, task in product((ACROSS, WITHIN), MEASURES, TASKS):
                a, b = shown.column(measure), shown.column(task)
                if scope == WITHIN:
                    a, b = _less_mean(a, cell), _less_mean(b, cell)
                found = spearman_over(a, b, offset, f"{recording} {measure} {task} {scope}")
                names = {"scope": scope, "measure": MEASURES[measure], "task": TASKS[task]}
                interval = {"spearman": found.value, "low": found.low, "high": found.high}
                rows.append({"recording": recording, **names, **interval, "runs": len(a)})
        return rows

    def tables(self, rows: FigureRows) -> list[str]:
        lines: list[str] = []
        for recording, scope in rows.distinct("recording", "scope"):
            shown = rows.where(recording=recording, scope=scope)
            cells = [[m, *map(_spelled, shown.where(measure=m))] for m in MEASURES.values()]
            table = aligned([["", *TASKS.values()], *cells])
            lines += [f"{recording}, {scope}: Spearman's correlation [95 %]", *table, ""]
        for recording in rows.distinct("recording"):
            shown = self.runs.where(recording=recording)
            cells = [
                [POLICIES[policy][0], *(f"{shown.mean(column, policy=policy):.3f}" for column in (*MEASURES, *TASKS))]
                for policy in sorted(self.policies, key=lambda name: shown.mean("rmse_mm", policy=name))
            ]
            heads = ["policy", *MEASURES.values(), *TASKS.values()]
            lines += [f"{recording}, mean of all runs (of failures: their part):", *aligned([heads, *cells]), ""]
        return lines[:-1]

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        best, reached = {}, []
        for recording in self.recordings:
            for task in ("map error", "tracking failure"):
                shown = rows.where(recording=recording, scope=WITHIN, task=task)
                known = [row for row in shown if not np.isnan(row["spearman"])]
                if known:
                    row = min(known, key=lambda row: float(row["spearman"]))
                    best[recording, task] = f"{row['measure']} ({_spelled(row)})"
                    reached.append(shown.where(measure="motion")[0]["low"] <= row["spearman"])
        asked = rows.where(scope=ACROSS, task="map error")
        wrong = [f"{row['measure']} on {row['recording']}" for row in asked if not row["high"] < 0]
        return {
            "stands": not wrong,
            "right": len(asked) - len(wrong),
            "asked": len(asked),
            "wrong": listed(wrong),
            "best": all(reached) if reached else None,
            "ranking": "; ".join(f"{task} on {where}: {text}" for (where, task), text in best.items()) or "unknown",
        }

    def size_inches(self, rows: FigureRows) -> tuple[float, float]:
        return 11.0, 3.7 * len(self.recordings) + 0.4

    def draw(self, rows: FigureRows, figure: Any) -> None:
        colours = (COLOURS["other"], COLOURS["afr"], COLOURS["random"], COLOURS["orange"], COLOURS["pink"])
        pairs = rows.distinct("recording", "scope")
        panels = figure.subplots(len(self.recordings), 2, squeeze=False, sharey=True)
        ticks = np.arange(len(TASKS))
        for axes, (recording, scope) in zip(panels.flat, pairs, strict=True):
            for n, (measure, colour) in enumerate(zip(MEASURES.values(), colours, strict=True)):
                shown = rows.where(recording=recording, scope=scope, measure=measure)
                value, low, high = (shown.column(name) for name in ("spearman", "low", "high"))
                aside = ticks + 0.15 * (n - (len(MEASURES) - 1) / 2)
                axes.vlines(aside, low, high, color=colour, linewidth=1.5)
                axes.plot(aside, value, "o", color=colour, markersize=5, label=measure)
            axes.axhline(0, color=".4", linewidth=0.8)
            axes.set_xticks(ticks, [text.replace(" ", "\n", 1) for text in TASKS.values()], fontsize=8)
            whose = "all runs" if scope == ACROSS else "policies at the same L and fade"
            finish(axes, f"{recording}: {whose}", ylim=(-1, 0.4))
        for axes in panels[:, 0]:
            axes.set_ylabel("Spearman's correlation\n(lower is better)")
        legend_below(figure, 5, panels[0, 0])


def _less_mean(numbers: NDArray[np.float64], cell: list[Any]) -> NDArray[np.float64]:
    """Subtract from each number the mean of its cell."""
    _, place = np.unique(np.array(cell), axis=0, return_inverse=True)
    means = np.bincount(place, numbers) / np.bincount(place)
    return np.asarray(numbers - means[place], np.float64)


def _spelled(row: Row) -> str:
    if np.isnan(row["spearman"]):
        return NONE
    return f"{row['spearman']:+.2f} [{row['low']:+.2f}, {row['high']:+.2f}]"


def spearman_over(a: NDArray[np.float64], b: NDArray[np.float64], group: NDArray[np.int64], label: str) -> Interval:
    """Correlate with a bootstrap interval that draws whole groups, because members of a group are dependent."""
    members = [np.flatnonzero(group == g) for g in np.unique(group)]
    rng = stream(0, label)
    numbers = [spearman(a, b)]
    for _ in range(RESAMPLES):
        drawn = np.concatenate([members[k] for k in rng.integers(0, len(members), len(members))])
        numbers.append(spearman(a[drawn], b[drawn]))
    return interval(np.array(numbers), len(members), within=(-1, 1))
