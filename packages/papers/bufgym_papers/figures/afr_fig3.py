"""V of the four motions of `afr_views`, computed from the overlap of views, beside the AFR paper's formulas."""

from dataclasses import dataclass
from typing import Any

from bufgym_papers.figures.afr_views import MESSAGES, GeometryFigure
from bufgym_papers.figures.figure import COLOURS, finish
from bufgym_papers.figures.rows import FigureRows


@dataclass(frozen=True)
class Reproduction(GeometryFigure):
    """Plot of V(d) for the four motions."""

    SIZE_INCHES = (7.0, 4.2)

    def tables(self, rows: FigureRows) -> list[str]:
        return FigureRows(row for row in rows if row["d"] in (0, 1, 2, 4, 8, 16)).pivot("d", "motion", "V", ".4f")

    def draw(self, rows: FigureRows, figure: Any) -> None:
        axes = figure.add_subplot()
        for (name, motion), colour in zip(
            self.motions().items(), ("pink", "afr", "random", "drop-oldest"), strict=True
        ):
            d = rows.column("d", motion=name)
            axes.plot(d, rows.column("formula", motion=name), color=COLOURS[colour], linewidth=1.2)
            label = f"{motion.label}: {motion.formula.name}"
            axes.plot(d, rows.column("V", motion=name), "o", color=COLOURS[colour], markersize=4, label=label)
        finish(axes, "V from the overlap of views (marks) and by the formula (lines)", ylim=(0, 1.05))
        axes.set(xlabel="d, messages between two that are received", ylabel="V(d), part of the view that is new")
        axes.set_xticks(range(0, MESSAGES + 1, 2))
        axes.legend(frameon=False)
