"""Fig. 1 of the AFR paper: the models that tracking makes of the frames received, coloured by error."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bufgym_papers.figures.afr_fig7 import plan_of, some_of
from bufgym_papers.figures.figure import about
from bufgym_papers.figures.frame_runs import POLICIES, FrameFigure, FrameRun
from bufgym_papers.figures.rows import FigureRows
from bufgym_papers.perception import mapping

PAPER_S = {"drop-oldest": 23.0, "random": 7.0}  # Policy -> second at which tracking fails in the paper
LIMIT_MM = 50.0  # Distance from the reference that is drawn darkest


@dataclass(frozen=True)
class Reproduction(FrameFigure):
    """Tracked models at one queue size, the fade where the paper has it."""

    capacities: Sequence[int] = (15,)
    policies: Sequence[str] = ("drop-oldest", "random", "afr")
    offsets: int = 1

    def simulate(self) -> FigureRows:
        return self.play("track")

    def ended_s(self, row: Any) -> float:
        """The second at which tracking breaks; infinite where it goes on to the end."""
        return float(self.stage(row["recording"]).whole.time_us[row["failed_at"]]) / 1e6 if row["failed"] else np.inf

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        ends = {(row["recording"], row["policy"]): self.ended_s(row) for row in rows.where(k=0)}
        main, facts = self.recordings[-1], dict[str, Any]()
        for policy in self.policies:
            ends_s = (ends[name, policy] for name in self.recordings)
            texts = ("to the end" if s == np.inf else f"breaks at second {s:.1f}" for s in ends_s)
            facts[f"{policy.removeprefix('drop-')}_end"] = self.of_each(texts)
        limits = {policy: about(at_s) for policy, at_s in PAPER_S.items()}
        near = {policy: low <= ends[main, policy] <= high for policy, (low, high) in limits.items()}
        return facts | {"afr": ends[main, "afr"] == np.inf, "oldest": near["drop-oldest"], "random": near["random"]}

    def size_inches(self, rows: FigureRows) -> tuple[float, float]:
        return 13.0, 4.2 * len(self.recordings)

    def draw(self, rows: FigureRows, figure: Any) -> None:
        columns = 1 + len(self.policies)
        panels = figure.subplots(len(self.recordings), columns, squeeze=False, sharex="row", sharey="row")
        for line, recording in zip(panels, self.recordings, strict=True):
            on, L = self.stage(recording), self.capacities[0]
            reference = on.tracked_reference.points()
            models = {"reference": reference}
            for policy in self.policies:
                models[POLICIES[policy][0]] = on.track_of(self.kept(FrameRun(recording, 0, L, policy))).model.points()
            for axes, (label, points) in zip(line, models.items(), strict=True):
                few = points[some_of(len(points))]
                far_mm = np.minimum(1e3 * mapping.distances(few, reference), LIMIT_MM)
                painted = axes.scatter(
                    *(few @ plan_of(reference)).T, s=0.4, c=far_mm, cmap="turbo", vmin=0, vmax=LIMIT_MM
                )
                axes.set_aspect("equal")
                axes.set_axis_off()
                axes.set_title(f"{recording}, {label}", fontsize=9, loc="left")
        figure.colorbar(painted, ax=panels, label="distance to the reference, mm", shrink=0.6)
