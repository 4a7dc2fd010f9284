"""Rows of a figure's numbers: queries, and tables of text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.benchmark.rows import Row, write_rows
from bufgym.utils.tables import aligned


class FigureRows(list[Row]):
    """Rows with the same columns. In each method ``where`` selects rows whose columns have these values."""

    def where(self, **values: object) -> FigureRows:
        return FigureRows(row for row in self if all(row[name] == value for name, value in values.items()))

    def column(self, name: str, **where: object) -> NDArray[np.float64]:
        """Return one column, float64[rows]."""
        return np.array([row[name] for row in self.where(**where)], np.float64)

    def mean(self, name: str, **where: object) -> float:
        """Mean of a column; NaN without rows."""
        return average(self.column(name, **where))

    def distinct(self, *names: str) -> list[Any]:
        """List the distinct values of a column in row order; several columns give tuples."""
        values = (row[names[0]] if len(names) == 1 else tuple(row[name] for name in names) for row in self)
        return list(dict.fromkeys(values))

    def pivot(self, index: str, by: str, value: str, spec: str, labels: Mapping[Any, str] | None = None) -> list[str]:
        """Tabulate means of the column ``value``, with a line per value of ``index`` and a column per value of ``by``.

        ``labels`` are names of lines and columns to show instead of their values.
        """
        known = labels or {}

        def label(value: Any) -> str:
            return known.get(value, f"{value:g}" if isinstance(value, float) else str(value))

        heads = self.distinct(by)
        lines = [[index, *map(label, heads)]]
        for key in self.distinct(index):
            means = (self.mean(value, **{index: key, by: head}) for head in heads)
            lines.append([label(key), *(format(number, spec) for number in means)])
        return aligned(lines)

    def listing(self, columns: Mapping[str, tuple[str, str]], left: int = 1) -> list[str]:
        """Tabulate with a line per row; ``columns`` maps a head to a column and the format of its numbers."""
        cells = (
            ["-" if row[name] is None else format(row[name], spec) for name, spec in columns.values()] for row in self
        )
        return aligned([list(columns), *cells], left)

    def save(self, path: Path) -> Path:
        """Write the rows as CSV; return the path."""
        path.parent.mkdir(parents=True, exist_ok=True)
        return write_rows(self, path)


def average(numbers: NDArray[np.float64]) -> float:
    return float(numbers.mean()) if len(numbers) else math.nan


def listed(numbers: Sequence[Any]) -> str:
    """Join as in ``1, 2, 3``; an empty sequence gives ``none``."""
    return ", ".join(map(str, numbers)) or "none"
