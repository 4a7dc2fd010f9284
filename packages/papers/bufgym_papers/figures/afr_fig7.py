"""Fig. 7 of the AFR paper: error of the map made of the frames received, against the queue size.

``perception.mapping`` fuses the frames with their true poses, as the paper does (Sec. V-B), and compares the map with
the map of all frames: one way, from each point of the map to the reference, as the paper measures, and both ways. A
second map uses the poses that tracking finds along the frames received, up to where tracking breaks. It shows whether
tracked poses would explain a difference from the paper.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.benchmark.bootstrap import Interval
from bufgym_papers.figures.figure import about, heat_table, of_all, within
from bufgym_papers.figures.frame_runs import POLICIES, FrameFigure, FrameRun, over_places, spearman
from bufgym_papers.figures.rows import FigureRows
from bufgym_papers.perception import mapping

RESAMPLES = 2000
MUCH = 0.1  # A change of the error by more than this share counts as much
ONE_WAY, BOTH_WAYS = "to_reference_mm", "rmse_mm"
PAPER = {"drop-oldest": -0.20, "random": -0.10, "orbbuf-images": -0.10}
"""Policy -> AFR's error relative to the policy's error, less 1, as the paper roughly gives it."""
SHOWN = ("drop-oldest", "random", "afr")  # Policies whose maps are drawn, at the smallest L and the paper's alignment
SLICE = 30_000  # Number of points drawn of a map


def change(rows: FigureRows, column: str, policy: str, other: str) -> Interval:
    """Divide the column's mean under ``policy`` by its mean under ``other`` and subtract 1."""
    ours, theirs = (
        np.array([rows.mean(column, k=k, policy=name) for k in rows.distinct("k")]) for name in (policy, other)
    )
    return over_places(ours - theirs, f"{column} {policy} {other}", theirs)


def spelled(interval: Interval) -> str:
    """Format an interval as in -7 % [-9, -4]."""
    return f"{interval.value:+.1%} [{interval.low:+.1%}, {interval.high:+.1%}]"


@dataclass(frozen=True)
class Reproduction(FrameFigure):
    """Map error of each policy at each L on each recording."""

    def simulate(self) -> FigureRows:
        return self.play("map", "track")

    def tables(self, rows: FigureRows) -> list[str]:
        lines: list[str] = []
        labels: dict[Any, str] = {name: style[0] for name, style in POLICIES.items()}
        for recording in rows.distinct("recording"):
            for title, some in (("the paper's alignment", rows.where(k=0)), ("the sweep", rows)):
                shown = some.where(recording=recording)
                for way, column in (("one way", ONE_WAY), ("both ways", BOTH_WAYS)):
                    head = f"{recording}, RMSE of the map in mm by L, {way}, {title}:"
                    lines += [head, *shown.pivot("policy", "L", column, ".2f", labels), ""]
        return lines[:-1]

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        main = self.recordings[-1]
        facts: dict[str, Any] = {"main": main, "moves": "not run"}
        for other, paper in PAPER.items():
            key = other.removeprefix("drop-").removesuffix("-images")
            facts[key] = None
            columns = {"change": ONE_WAY, "both": BOTH_WAYS, "slam": "slam_rmse_mm", "lack": "slam_uncovered"}
            facts |= {f"{key}_{what}": "not run" for what in (*columns, "paper")}
            if {"afr", other} <= set(self.policies):
                facts[key] = within(change(rows.where(recording=main), ONE_WAY, "afr", other), *about(paper))
                for what, column in columns.items():
                    texts = (spelled(change(rows.where(recording=r), column, "afr", other)) for r in self.recordings)
                    facts[f"{key}_{what}"] = self.of_each(texts)
                changes = (change(rows.where(recording=r, k=0), ONE_WAY, "afr", other) for r in self.recordings)
                facts[f"{key}_paper"] = self.of_each(f"{found.value:+.1%}" for found in changes)
        if {"afr", "drop-oldest", "random"} <= set(self.policies) and len(self.capacities) > 1:
            compared = [name for name in (*SHOWN, "orbbuf-images") if name in self.policies]
            grown = {name: self.by_size(rows.where(recording=main, policy=name)) for name in compared}
            limits = {"afr": (-1.0, 0.0)}
            facts["larger"] = of_all(within(grown[name], *limits.get(name, (-MUCH, np.inf))) for name in compared)
            facts["sizes"] = "; ".join(f"{POLICIES[name][0]} {spelled(found)}" for name, found in grown.items())
        else:
            facts |= {"larger": None, "sizes": "not run"}
        if "drop-oldest" in self.policies and "afr" in self.policies:
            facts["moves"] = self.where_it_moves(rows.where(recording=main))
        return facts

    def by_size(self, rows: FigureRows) -> Interval:
        """The mean error at the largest L relative to that at the smallest, less 1, over the places of the fade."""
        sizes = (max(self.capacities), min(self.capacities))
        large, small = (np.array([rows.mean(ONE_WAY, k=k, L=L) for k in rows.distinct("k")]) for L in sizes)
        return over_places(large - small, "sizes", small)

    def where_it_moves(self, rows: FigureRows) -> str:
        """Correlate camera motion in Drop Oldest's longest gap with AFR's change of the error, over the offsets."""
        moved, won, recording = [], [], rows[0]["recording"]
        x = self.x_of(recording)
        for k in rows.distinct("k"):
            kept = [self.kept(FrameRun(recording, k, L, "drop-oldest")) for L in self.capacities]
            moved.append(float(np.mean([np.diff(x[list(frames)]).max() for frames in kept])))
            won.append(rows.mean(ONE_WAY, k=k, policy="afr") / rows.mean(ONE_WAY, k=k, policy="drop-oldest") - 1)
        return f"{spearman(np.array(moved), np.array(won)):+.2f}"

    def size_inches(self, rows: FigureRows) -> tuple[float, float]:
        return 13.0, 0.9 + 0.28 * len(self.policies) + 4.6 * len(self.recordings)

    @property
    def shown(self) -> list[str]:
        return [name for name in SHOWN if name in self.policies] or [self.policies[0]]

    def draw(self, rows: FigureRows, figure: Any) -> None:
        heights = [0.9 + 0.28 * len(self.policies), *[4.6] * len(self.recordings)]
        above, *below = figure.subfigures(len(heights), 1, height_ratios=heights)
        panels = above.subplots(1, 2 * len(self.recordings), squeeze=False, sharey=True)[0]
        for n, recording in enumerate(self.recordings):
            of_both = [self._errors(some.where(recording=recording)) for some in (rows.where(k=0), rows)]
            least, most = np.min(of_both), np.max(of_both)
            titles = ("the paper's alignment", f"mean of the {self.offsets} of the sweep")
            for axes, errors, title in zip(panels[2 * n :], of_both, titles, strict=False):
                labels = [POLICIES[policy][0] for policy in self.policies]
                columns = [*map(str, self.capacities), "mean"]
                heat_table(axes, errors, ".2f", labels, columns, vmin=least, vmax=most + 0.25 * (most - least))
                axes.axvline(len(self.capacities) - 0.5, color="white", linewidth=4)
                axes.set_title(f"{recording}: {title}", loc="left", fontsize=10)
                axes.set_xlabel("RMSE in mm, one way, by queue size L", fontsize=9)
        for part, recording in zip(below, self.recordings, strict=True):
            self._maps(part, recording)

    def _errors(self, rows: FigureRows) -> NDArray[np.float64]:
        """Errors in mm, [policies, L and their mean]."""
        by_L = [[rows.mean(ONE_WAY, policy=policy, L=L) for L in self.capacities] for policy in self.policies]
        return np.column_stack([by_L, np.mean(by_L, axis=1)])

    def _maps(self, part: Any, recording: str) -> None:
        """Draw the full map from above per policy and kind of pose, coloured by the distance to the policy's map."""
        on, L = self.stage(recording), min(self.capacities)
        limit_mm = 20.0
        panels = part.subplots(2, len(self.shown), squeeze=False, sharex=True, sharey=True)
        plan = plan_of(on.reference.points())
        for line, poses in zip(panels, ("true poses", "tracked"), strict=True):
            every = (on.reference if poses == "true poses" else on.tracked_reference).points()
            few = some_of(len(every))
            for axes, policy in zip(line, self.shown, strict=True):
                kept = self.kept(FrameRun(recording, 0, L, policy))
                made = on.map_of(kept) if poses == "true poses" else on.track_of(kept).model
                # Distances run from the reference's points to the map, so that missing parts stand out.
                far_mm = np.minimum(1e3 * mapping.distances(every[few], made.points()), limit_mm)
                painted = axes.scatter(*(every[few] @ plan).T, s=0.4, c=far_mm, cmap="inferno_r", vmin=0, vmax=limit_mm)
                axes.set_aspect("equal")
                axes.set_axis_off()
                axes.set_title(f"{recording}, {POLICIES[policy][0]}, {poses}", fontsize=9, loc="left")
        label = f"distance to this map, mm (L = {L})"
        part.colorbar(painted, ax=panels, label=label, shrink=0.7, ticks=[0, 10, 20], format="%d")


def some_of(points: int) -> NDArray[np.int64]:
    """Choose the points to draw, the same for every map."""
    return np.random.Generator(np.random.PCG64(0)).permutation(points)[:SLICE]


def plan_of(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Find the two directions in which the points spread most, float64[3, 2]; they span the plan."""
    some = points[some_of(len(points))[:2000]]
    _, _, axes = np.linalg.svd(some - some.mean(axis=0), full_matrices=False)
    return np.asarray(axes[:2].T, np.float64)
