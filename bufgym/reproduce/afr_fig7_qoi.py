"""Fig. 7 of the AFR paper, in information instead of map error: what each policy loses, against the queue size.

The paper's ordinate is the RMSE of the map that SLAM builds of the frames received. Ours is the Quantity of
Information that they lack, measured twice: regret = 1 - H / H of the clairvoyant counts what a better policy could have
had over the same link; loss = 1 - H / H of all frames counts what the link could not carry, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from bufgym.reproduce.afr_evaluation import STYLES, StreamFigure
from bufgym.reproduce.figure import finish, legend_below
from bufgym.reproduce.rows import Rows, table


@dataclass(frozen=True)
class Reproduction(StreamFigure):
    """QoI lost by each policy at each L, over each link and camera, and with time-based QoI."""

    def simulate(self) -> Rows:
        return self.play(self.settings(timed=True), self.runs, bound=True)

    def tables(self, rows: Rows) -> list[str]:
        lines: list[str] = []
        for setting, camera, scale in rows.distinct("setting", "camera", "link_scale"):
            cells = [["L", *map(str, self.capacities)]]
            for policy in STYLES:
                played = [rows.where(setting=setting, policy=policy, L=L) for L in self.capacities]
                cells.append([policy, *(f"{100 * p.mean('regret'):.2f} / {100 * p.mean('loss'):.2f}" for p in played)])
            by = "frame index, V = 1 - 0.618^d" if camera == "time" else f"motion of {camera}, V = 1 - exp(-d)"
            carried = min(self.share_carried(scale), 9.99)
            lines += [f"{setting} ({carried:.0%} of the demand): {by}. Mean regret / loss, %:", *table(cells), ""]
        return lines[:-1]

    def claims(self, rows: Rows) -> dict[str, Any]:
        facts: dict[str, Any] = {"about": self.about()}
        for other in ("drop-oldest", "random", "orbbuf"):
            settings = [rows.where(setting=setting) for setting in rows.distinct("setting")]
            changes = [[_against(played, name, other) for name in ("loss", "regret")] for played in settings]
            key = other.removeprefix("drop-")
            facts[key] = all(regret < 0 for _, regret in changes)
            facts[f"against_{key}"] = "; ".join(
                f"{played[0]['setting']} {loss:+.1%} ({regret:+.0%})"
                for played, (loss, regret) in zip(settings, changes, strict=True)
            )
        return facts

    def size_inches(self, rows: Rows) -> tuple[float, float]:
        columns, panels = len(self.cameras) + 1, len(rows.distinct("setting"))
        return 3.9 * columns + 0.6, 3.0 * (panels // columns) + 0.6

    def draw(self, rows: Rows, figure: Any) -> None:
        settings = rows.distinct("setting")
        columns = len(self.cameras) + 1
        grid = figure.subplots(len(settings) // columns, columns, squeeze=False)
        for axes, setting in zip(grid.flat, settings, strict=True):
            self._boxes(axes, rows.where(setting=setting))
            finish(axes, setting, ylim=(0, None))
        for axes in grid[:, 0]:
            axes.set_ylabel("regret, % of the clairvoyant's H")
        for axes in grid[-1]:
            axes.set_xlabel("queue size L")
        legend_below(figure, 5, grid[0, 0])

    def _boxes(self, axes: Any, rows: Rows) -> None:
        """One group of boxes a queue size: median, quartiles, extremes; a mark at the mean."""
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


def _against(rows: Rows, name: str, other: str) -> float:
    """Mean of AFR's column over that of ``other``, less 1; 0 where the other's is 0."""
    afr, rival = rows.mean(name, policy="afr"), rows.mean(name, policy=other)
    return afr / rival - 1 if rival > 0 else 0.0
