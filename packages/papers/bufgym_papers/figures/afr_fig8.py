"""Fig. 8 of the AFR paper: runs in which tracking breaks on the frames received.

``perception.tracking`` aligns each frame to the model and states when tracking counts as broken. The paper
repeats one alignment ten times; we place the fade at ten places that were fixed beforehand.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from bufgym.benchmark.bootstrap import Interval
from bufgym.utils.tables import aligned
from bufgym_papers.figures.figure import about, finish, heat_table, of_all, within
from bufgym_papers.figures.frame_runs import POLICIES, FrameFigure, over_places
from bufgym_papers.figures.rows import FigureRows
from bufgym_papers.perception.stage import IMAGES

THIRD = 1 / 3  # Largest ratio of AFR's failures to Drop Oldest's that passes our own check
HELP = 0.1  # A larger queue helps if it lowers the share of runs that fail by this much
HALF = 1 / 2  # ORBBuf's failures are greatly reduced if they are at most this share of Drop Oldest's
COLUMNS = 4  # Columns of small pictures of the camera's path


@dataclass(frozen=True)
class Reproduction(FrameFigure):
    """Tracking failures under each policy at each L on each recording."""

    def simulate(self) -> FigureRows:
        return self.play("track")

    def tables(self, rows: FigureRows) -> list[str]:
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
            lines += [f"{recording}, runs of {self.offsets} in which tracking breaks, by L:", *aligned(cells), ""]
        return lines[:-1]

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        broken = {
            name: {policy: failures(rows, recording=name, policy=policy) for policy in self.policies}
            for name in self.recordings
        }
        runs = len(rows.where(recording=self.recordings[0], policy=self.policies[0]))
        not_run = ("by_size", "oldest_rate", "afr_rate", "random_rate", "large_count", "third_count", "orbbuf_count")
        facts: dict[str, Any] = {"runs": runs, **dict.fromkeys(not_run, "not run")}
        facts["counts"] = "; ".join(
            f"{name}: " + ", ".join(f"{POLICIES[policy][0]} {count}" for policy, count in counts.items())
            for name, counts in broken.items()
        )

        def against_oldest(policy: str) -> str:
            """Failures of this policy and of Drop Oldest on every recording."""
            return self.of_each(f"{counts[policy]} against {counts['drop-oldest']}" for counts in broken.values())

        def everywhere(rule: Callable[[dict[str, int]], bool]) -> bool:
            return all(rule(counts) for counts in broken.values())

        small, large_L = min(self.capacities), max(self.capacities)
        shown = [name for name in ("drop-oldest", "random") if name in self.policies and small < large_L]
        if shown:
            grown = {name: self.by_size(rows.where(policy=name), small, large_L) for name in shown}
            facts["sizes"] = of_all(within(found, np.nextafter(-HELP, 0), 1.0) for found in grown.values())
            texts = (f"{POLICIES[name][0]} {r.value:+.0%} [{r.low:+.0%}, {r.high:+.0%}]" for name, r in grown.items())
            facts["by_size"] = "; ".join(texts)
        if {"afr", "drop-oldest"} <= set(self.policies):
            rates = {
                policy: {name: rate(rows.where(recording=name, policy=policy)) for name in self.recordings}
                for policy in ("drop-oldest", "afr", "random")
                if policy in self.policies
            }
            facts["oldest"] = of_all(
                within(found, about(0.4)[0], about(0.6)[1]) for found in rates["drop-oldest"].values()
            )
            if IMAGES in self.policies:
                pairs = [(counts[IMAGES], counts["drop-oldest"]) for counts in broken.values()]
                facts["orbbuf"] = all(ours <= HALF * theirs for ours, theirs in pairs)
                facts["orbbuf_count"] = against_oldest(IMAGES)
            for policy in rates:
                texts = (f"{r.value:.0%} [{r.low:.0%}, {r.high:.0%}]" for r in rates[policy].values())
                facts[f"{policy.removeprefix('drop-')}_rate"] = self.of_each(texts)
            facts["third_count"] = against_oldest("afr")
            large = FigureRows(row for row in rows if row["L"] > 10)
            facts["large_count"] = failures(large, policy="afr")
            facts |= dict.fromkeys(("afr", "third", "large"))
            if everywhere(lambda counts: counts["drop-oldest"] > 0):  # else AFR has nothing to improve
                facts["afr"] = of_all(within(found, 0.0, np.nextafter(0.1, 0)) for found in rates["afr"].values())
                facts["third"] = everywhere(lambda counts: counts["afr"] <= THIRD * counts["drop-oldest"])
                facts["large"] = failures(large, policy="afr") == 0 if large else None
        return facts

    def by_size(self, rows: FigureRows, small: int, large: int) -> Interval:
        """Share of runs that fail at the largest L less that at the smallest, over the places of the fade."""
        runs = len(self.recordings)
        fails = [[failures(rows, k=k, L=L) for L in (large, small)] for k in rows.distinct("k")]
        return over_places([(with_large - with_small) / runs for with_large, with_small in fails], "sizes")

    def size_inches(self, rows: FigureRows) -> tuple[float, float]:
        return 13.0, (0.4 + 1.7 * math.ceil(len(self.policies) / COLUMNS)) * len(self.recordings)

    def draw(self, rows: FigureRows, figure: Any) -> None:
        parts = figure.subfigures(len(self.recordings), 2, squeeze=False, width_ratios=[1, 1.7])
        for (left, right), recording in zip(parts, self.recordings, strict=True):
            shown = rows.where(recording=recording)
            self._counts(left.subplots(), recording, shown)
            self._broken(right, recording, shown)

    def _counts(self, axes: Any, recording: str, shown: FigureRows) -> None:
        counts = np.array([[failures(shown, policy=policy, L=L) for L in self.capacities] for policy in self.policies])
        labels = [POLICIES[policy][0] for policy in self.policies]
        heat_table(axes, counts, "d", labels, list(map(str, self.capacities)), vmin=0, vmax=1.25 * self.offsets)
        sums = axes.secondary_yaxis("right")
        sums.set_yticks(range(len(labels)), [f"{line.sum()} of {line.size * self.offsets}" for line in counts])
        sums.tick_params(length=0)
        sums.spines[:].set_visible(False)
        axes.set_title(f"{recording}: runs of {self.offsets} in which tracking breaks", loc="left", fontsize=10)
        axes.set_xlabel("queue size L")

    def _broken(self, part: Any, recording: str, shown: FigureRows) -> None:
        """Draw the camera's path from above for each policy, and where tracking broke along it."""
        places = self.stage(recording).whole.poses[:, :3, 3]
        across, along = np.argsort(np.ptp(places, axis=0))[:0:-1]
        lines = math.ceil(len(self.policies) / COLUMNS)
        panels = part.subplots(lines, COLUMNS, squeeze=False, sharex=True, sharey=True).ravel()
        for axes, policy in zip(panels, self.policies, strict=False):
            axes.plot(places[:, across], places[:, along], color=".75", linewidth=1, zorder=1)
            axes.plot(*places[0, [across, along]], ">", color=".4", markersize=5, zorder=1)
            at = places[[row["failed_at"] for row in shown.where(policy=policy) if row["failed"]]]
            axes.plot(at[:, across], at[:, along], "o", color=POLICIES[policy][1], alpha=0.5, markersize=5, mew=0)
            finish(axes, POLICIES[policy][0], aspect="equal")
            axes.tick_params(labelsize=8)
        for axes in panels[len(self.policies) :]:
            axes.remove()
        for axes in panels[::COLUMNS]:
            axes.set_ylabel("m", fontsize=8)
        part.suptitle(f"{recording}: where, all L (the way begins at the triangle)", x=0.02, ha="left", fontsize=10)


def rate(rows: FigureRows) -> Interval:
    """Share of the runs that fail; the interval draws offsets of the fade, each with all its runs."""
    return over_places([failures(rows, k=k) / len(rows.where(k=k)) for k in rows.distinct("k")], "failures")


def failures(rows: FigureRows, **where: object) -> int:
    return sum(bool(row["failed"]) for row in rows.where(**where))
