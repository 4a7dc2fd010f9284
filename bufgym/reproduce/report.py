"""What every reproduction returns: a text, a table, and how to draw it."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bufgym.errors import BufgymError

COLOURS = {
    "afr": "#0072b2",
    "drop-oldest": "#d55e00",
    "random": "#009e73",
    "oracle": "#555555",
    "oracle-ideal": "#111111",
    "other": "#999999",
}
"""One colour a policy, the same in every figure, told apart by colour-blind readers too (Okabe and Ito)."""


@dataclass(frozen=True)
class Report:
    """One reproduced figure or table."""

    text: str
    """Our numbers beside the paper's, to be printed."""
    header: Sequence[str]
    rows: Sequence[Sequence[object]] = field(repr=False)
    """The numbers themselves, one list a row, in the columns of ``header``."""
    draw: Callable[[Any], None] = field(repr=False)
    """Draws into an empty matplotlib figure."""
    size_inches: tuple[float, float] = (7.0, 4.5)

    def save_numbers(self, path: Path) -> Path:
        """Write the table as CSV; return its path."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file, lineterminator="\n").writerows([self.header, *self.rows])
        return path

    def save_figure(self, path: Path) -> Path:
        """Draw and write the PNG; return its path. An error that names the extra where matplotlib is absent."""
        try:
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.figure import Figure
        except ImportError:
            raise BufgymError("drawing needs matplotlib: pip install 'bufgym[plot]'") from None
        # Not through pyplot: no window, no state that outlives the file.
        figure = Figure(figsize=self.size_inches, layout="constrained")
        FigureCanvasAgg(figure)
        self.draw(figure)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)
        return path
