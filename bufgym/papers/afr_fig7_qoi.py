"""Fig. 7 of the AFR paper in information instead of map error: each policy's loss against the queue size.

The paper plots the RMSE of the map built from the frames received. We plot regret, 1 - H / H of the clairvoyant. It is
the fraction of the Quantity of Information that the best policy would have gained over the same link.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bufgym.papers.afr_evaluation import STYLES, StreamFigure
from bufgym.papers.figure import finish, legend_below
from bufgym.papers.rows import Rows, listed


@dataclass(frozen=True)
class Reproduction(StreamFigure):
    """QoI lost by each policy at each L over each link and camera, also with time-based QoI."""

    def simulate(self) -> Rows:
        return self.play(self.settings(timed=True), self.runs, bound=True)

    def tables(self, rows: Rows) -> list[str]:
        lines: list[str] = []
        for camera in rows.distinct("camera"):
            by = "frame index, V = 1 - 0.618^d" if camera == "time" else f"motion of {camera}, V = 1 - exp(-d)"
            shown = rows.where(camera=camera, size_kb=self.size_kb)
            lines += [f"Mean regret by L; {by}:", *shown.pivot("policy", "L", "regret", ".2%"), ""]
        for camera in rows.distinct("camera"):
            shown = rows.where(camera=camera)
            lines += [f"Mean regret by the size of a frame in kB, all L; {camera}:"]
            lines += [*shown.pivot("policy", "size_kb", "regret", ".2%"), ""]
        return lines[:-1]

    def claims(self, rows: Rows) -> dict[str, Any]:
        facts: dict[str, Any] = {"about": self.about()}
        for other in ("drop-oldest", "random", "orbbuf"):
            changes = {
                (size_kb, camera): _change(played.mean("regret", policy="afr"), played.mean("regret", policy=other))
                for size_kb, camera in rows.distinct("size_kb", "camera")
                for played in [rows.where(size_kb=size_kb, camera=camera)]
            }
            main = {camera: change for (size_kb, camera), change in changes.items() if size_kb == self.size_kb}
            key = other.removeprefix("drop-")
            facts[key] = all(change < 0 for change in main.values())
            facts[f"against_{key}"] = listed([f"{change:+.0%} ({camera})" for camera, change in main.items()])
            facts[f"range_{key}"] = f"{min(changes.values()):+.0%} to {max(changes.values()):+.0%}"
        return facts

    def size_inches(self, rows: Rows) -> tuple[float, float]:
        return 3.9 * len(rows.distinct("camera")) + 0.6, 3.6

    def draw(self, rows: Rows, figure: Any) -> None:
        cameras = rows.distinct("camera")
        for axes, camera in zip(figure.subplots(1, len(cameras), squeeze=False)[0], cameras, strict=True):
            self._boxes(axes, rows.where(camera=camera, size_kb=self.size_kb))
            finish(axes, f"{camera}, {self.size_kb:g} kB", ylim=(0, None), xlabel="queue size L")
        figure.axes[0].set_ylabel("regret, % of the clairvoyant's H")
        legend_below(figure, 5, figure.axes[0])

    def _boxes(self, axes: Any, rows: Rows) -> None:
        """Draw one group of boxes per queue size with median, quartiles and extremes, and mark the mean."""
        width, ticks = 0.8 / len(STYLES), np.arange(len(self.capacities))
        for k, (policy, (label, colour, marker)) in enumerate(STYLES.items()):
            line = {"color": colour}
            axes.boxplot(
                [100 * rows.column("regret", policy=policy, L=L) for L in self.capacities],
                positions=ticks + (k - (len(STYLES) - 1) / 2) * width,
                widths=0.85 * width,
                whis=(0, 100),
                patch_artist=True,
                manage_ticks=False,
                boxprops={"facecolor": colour, "edgecolor": colour, "alpha": 0.75},
                whiskerprops=line,
                capprops=line,
                medianprops={"color": "black", "linewidth": 1},
                showmeans=True,
                meanprops={"marker": marker, "markersize": 4.5, "markerfacecolor": colour, "markeredgecolor": "white"},
            )
            axes.plot([], [], marker, color=colour, label=label)
        axes.set_xticks(ticks, [str(L) for L in self.capacities])


def _change(regret: float, other: float) -> float:
    """Return the change relative to ``other``, or 0 where ``other`` is 0."""
    return regret / other - 1 if other > 0 else 0.0
