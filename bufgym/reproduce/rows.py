"""The numbers of a figure as rows, what they are asked for, and how tables of them are written."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.files import replaced

Row = dict[str, Any]
"""Column -> text, number or None."""


class Rows(list[Row]):
    """Rows with the same columns; in each method ``where`` limits them to those whose columns have these values."""

    def where(self, **values: object) -> Rows:
        return Rows(row for row in self if all(row[name] == value for name, value in values.items()))

    def column(self, name: str, **where: object) -> NDArray[np.float64]:
        """One column, float64[rows]."""
        return np.array([row[name] for row in self.where(**where)], np.float64)

    def mean(self, name: str, **where: object) -> float:
        """Mean of a column; NaN without rows."""
        return average(self.column(name, **where))

    def distinct(self, *names: str) -> list[Any]:
        """The values of one column (tuples, of several), each once, in the order of the rows."""
        values = (row[names[0]] if len(names) == 1 else tuple(row[name] for name in names) for row in self)
        return list(dict.fromkeys(values))

    def pivot(self, index: str, by: str, value: str, spec: str, labels: Mapping[Any, str] | None = None) -> list[str]:
        """A table of means of the column ``value``: a line for each of ``index``, a column for each of ``by``.

        Args:
            spec: how a mean is written, such as ".1f" or ".0%".
            labels: what a line or column is called, where that is not its value.
        """
        known = labels or {}

        def label(value: Any) -> str:
            return known.get(value, f"{value:g}" if isinstance(value, float) else str(value))

        heads = self.distinct(by)
        lines = [[index, *map(label, heads)]]
        for key in self.distinct(index):
            means = (self.mean(value, **{index: key, by: head}) for head in heads)
            lines.append([label(key), *(format(number, spec) for number in means)])
        return table(lines)

    def save(self, path: Path) -> Path:
        """Write the rows as CSV; return the path."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with replaced(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(self[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(self)
        return path


def average(numbers: NDArray[np.float64]) -> float:
    """Mean; NaN of nothing."""
    return float(numbers.mean()) if len(numbers) else math.nan


def table(lines: Sequence[Sequence[object]], left: int = 1) -> list[str]:
    """Lines of a table with aligned columns: the first ``left`` flush left, the others flush right."""
    texts = [[str(cell) for cell in line] for line in lines]
    widths = [max(map(len, cells)) for cells in zip(*texts, strict=True)]
    return [
        "  ".join(f"{cell:{'<' if k < left else '>'}{widths[k]}}" for k, cell in enumerate(line)).rstrip()
        for line in texts
    ]


def listed(numbers: Sequence[Any]) -> str:
    """``1, 2, 3``; ``none`` for nothing."""
    return ", ".join(map(str, numbers)) or "none"
