"""Fig. 8 of the AFR paper: runs in which tracking breaks, along the frames received.

Tracking is frame-to-model (``bufgym.perception.tracking``, which also states when it counts as broken). The paper
repeats one alignment ten times; here a run has the fade at each of ten places, fixed beforehand.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from bufgym.reproduce.figure import finish, legend_below
from bufgym.reproduce.frame_runs import POLICIES, FrameFigure
from bufgym.reproduce.rows import Rows, table

THIRD = 1 / 3
"""Of Drop Oldest's failures AFR may have at most so many, by our own yardstick."""


@dataclass(frozen=True)
class Reproduction(FrameFigure):
    """Failures under each policy at each L, on each recording."""

    def simulate(self) -> Rows:
        return self.play("track")

    def tables(self, rows: Rows) -> list[str]:
        lines: list[str] = []
        for recording in rows.distinct("recording"):
            shown = rows.where(recording=recording)
            heads: list[object] = ["policy", *map(str, self.capacities), "all", "of", "paper's alignment, L that fail"]
            cells: list[list[object]] = [heads]
            for policy in self.policies:
                counts = [failures(shown, policy=policy, L=L) for L in self.capacities]
                first = [row["L"] for row in shown.where(policy=policy, k=0) if row["failed"]]
                of = len(shown.where(policy=policy))
                text = ", ".join(map(str, first)) or "none"
                cells.append([POLICIES[policy][0], *counts, sum(counts), of, text])
            lines += [f"{recording}, runs of {self.offsets} in which tracking breaks, by L:", *table(cells), ""]
        return lines[:-1]

    def claims(self, rows: Rows) -> dict[str, Any]:
        main = self.recordings[-1]
        shown = rows.where(recording=main)
        facts: dict[str, Any] = {"about": self.about(), "main": main, "offsets": self.offsets}
        rates = {policy: failures(shown, policy=policy) / len(shown.where(policy=policy)) for policy in self.policies}
        facts |= dict.fromkeys(("oldest_rate", "afr_rate"), math.nan)  # of policies that were not run
        facts |= dict.fromkeys(("large_count", "afr_count", "oldest_count", "learned_count"), "not run")
        large = Rows(row for row in shown if row["L"] > 10)
        facts["rates"] = ", ".join(f"{policy} {rate:.0%}" for policy, rate in rates.items())
        counts = {policy: failures(shown, policy=policy) for policy in self.policies}
        facts["counts"] = ", ".join(f"{policy} {count}" for policy, count in counts.items())
        facts["runs"] = len(shown.where(policy=self.policies[0]))
        if {"afr", "drop-oldest"} <= set(self.policies):
            facts["oldest"] = 0.4 <= rates["drop-oldest"] <= 0.6
            facts["oldest_rate"], facts["afr_rate"] = rates["drop-oldest"], rates["afr"]
            # Where Drop Oldest never fails, AFR has nothing to improve.
            tested = counts["drop-oldest"] > 0
            facts["afr"] = rates["afr"] < 0.1 if tested else None
            facts["third"] = counts["afr"] <= THIRD * counts["drop-oldest"] if tested else None
            facts["large"] = failures(large, policy="afr") == 0 if tested and large else None
            facts["large_count"] = failures(large, policy="afr")
            facts["afr_count"], facts["oldest_count"] = counts["afr"], counts["drop-oldest"]
        if {"afr", "learned-motion"} <= set(self.policies):
            facts["learned"] = counts["learned-motion"] <= counts["afr"]
            facts["learned_count"] = counts["learned-motion"]
        return facts

    def size_inches(self, rows: Rows) -> tuple[float, float]:
        return 11.0, 3.6 * len(self.recordings) + 0.8

    def draw(self, rows: Rows, figure: Any) -> None:
        panels = figure.subplots(len(self.recordings), 2, squeeze=False, width_ratios=[1, 1.2])
        for (left, right), recording in zip(panels, self.recordings, strict=True):
            shown = rows.where(recording=recording)
            ticks = np.arange(len(self.capacities))
            width = 0.85 / len(self.policies)
            for n, policy in enumerate(self.policies):
                label, colour, _ = POLICIES[policy]
                counts = [failures(shown, policy=policy, L=L) for L in self.capacities]
                aside = ticks + (n - (len(self.policies) - 1) / 2) * width
                left.bar(aside, counts, width, color=colour, label=label)
                left.plot(aside, [0.0] * len(aside), "|", color=colour, markersize=5)  # so that 0 is seen, too
            left.set_xticks(ticks, [str(L) for L in self.capacities])
            finish(left, f"{recording}: tracking breaks", xlabel="queue size L", ylabel=f"runs of {self.offsets}")
            left.set_ylim(0, 1.04 * self.offsets)
            self._broken(right, recording, shown)
        legend_below(figure, 4, panels[0][0])

    def _broken(self, axes: Any, recording: str, shown: Rows) -> None:
        """The camera's way from above, and where tracking broke along it."""
        places = self.stage(recording).whole.poses[:, :3, 3]
        across, along = np.argsort(np.ptp(places, axis=0))[:0:-1]
        axes.plot(places[:, across], places[:, along], color=".75", linewidth=1, zorder=1)
        axes.plot(*places[0, [across, along]], ">", color=".4", markersize=7, zorder=1)
        for policy in self.policies:
            _, colour, marker = POLICIES[policy]
            where = [row["failed_at"] for row in shown.where(policy=policy) if row["failed"]]
            if where:
                at = places[where]
                axes.plot(at[:, across], at[:, along], marker, color=colour, alpha=0.7, markersize=6)
        finish(axes, f"{recording}: where it broke, all L (the way begins at the triangle)")
        axes.set(xlabel="m", ylabel="m", aspect="equal")


def failures(rows: Rows, **where: object) -> int:
    """Runs in which tracking broke."""
    return sum(bool(row["failed"]) for row in rows.where(**where))
