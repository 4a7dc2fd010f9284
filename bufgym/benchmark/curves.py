"""``bufgym.curves``: learning curves over training seeds, with intervals, from the folders of runs.

A run's folder has a folder ``seed-N`` for each seed, with one of two files: ``validation.csv`` of ``train.py``, or the
``0.monitor.csv`` that ``make_vec_env(..., monitor_dir=...)`` writes, as stable-baselines3's ``Monitor`` does.
"""

import csv
import io
import math
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.benchmark.bootstrap import CONFIDENCE, students_t
from bufgym.utils.errors import BufgymError, unknown, where
from bufgym.utils.files import read_utf8, replaced
from bufgym.utils.libraries import library

MAX_BYTES = 2**28  # Largest file of a seed, bytes
BINS = 30  # Means of so many parts of a run stand for the returns of its single episodes
Numbers = NDArray[np.float64]


class Curve(NamedTuple):
    """One run: means over its seeds, with 95 % intervals for another seed's mean of as many."""

    name: str  # of the folder
    measure: str  # what the numbers are
    steps: Numbers  # float64[points], steps in the environment
    seeds: Numbers  # float64[seeds, points]

    @property
    def mean(self) -> Numbers:
        """float64[points]."""
        return np.asarray(self.seeds.mean(axis=0))

    @property
    def reach(self) -> Numbers:
        """float64[points]: half the width of the interval, Student's t over seeds; NaN for a single seed."""
        n = len(self.seeds)
        if n < 2:
            return np.full(len(self.steps), math.nan)
        return np.asarray(students_t(CONFIDENCE, n - 1) * self.seeds.std(axis=0, ddof=1) / math.sqrt(n))


def read_curve(run: str | PathLike[str], measure: str | None = None) -> Curve:
    """The curve of a run's folder; ``measure`` is a column, by default the last of validation.csv, or the return."""
    home = Path(run)
    folders = sorted(home.glob("seed-*")) if home.is_dir() else []
    found = [_of_seed(folder, measure) for folder in folders]
    if not found:
        raise BufgymError(f"{run}: no folders seed-0, seed-1, ...; a run of train.py, or of your own, has one a seed")
    names = {name for name, _ in found}
    if len(names) > 1:
        raise BufgymError(f"{run}: its seeds have {' and '.join(sorted(names))}: must be one measure")
    points = [points for _, points in found]
    first, last = max(p[0, 0] for p in points), min(p[-1, 0] for p in points)
    steps = np.unique(np.concatenate([p[:, 0] for p in points]))
    steps = steps[(steps >= first) & (steps <= last)] if first <= last else steps[:0]
    if not len(steps):
        raise BufgymError(f"{run}: its seeds have no steps in common")
    steps = steps if len(steps) <= 2 * BINS else np.linspace(first, last, BINS)
    return Curve(home.name, names.pop(), steps, np.array([np.interp(steps, *p.T) for p in points]))


def curves(
    runs: str | PathLike[str] | Sequence[str | PathLike[str]], out: str | PathLike[str], measure: str | None = None
) -> list[Curve]:
    """Draw runs over their training seeds: a line for the mean, a band for its 95 % interval, points of the seeds thin.

    Args:
        runs: folders with a folder ``seed-N`` for each seed.
        out: the picture, .svg, .png or .pdf.
        measure: the column to draw, by default the last of validation.csv, or the return of monitor files.

    Returns:
        The curves as numbers.

    Raises:
        BufgymError: a folder has no seeds, a file is broken, or the picture cannot be written.
    """
    folders = [runs] if isinstance(runs, str | PathLike) else list(runs)
    if not folders:
        raise BufgymError("runs = []: need at least one folder")
    target = Path(out)
    if target.suffix not in (".svg", ".png", ".pdf") or not target.absolute().parent.is_dir():
        raise BufgymError(f"out = {out}: must be FILE.svg, .png or .pdf in a folder that there is")
    found = [read_curve(run, measure) for run in folders]
    library("matplotlib", "plot", "curves")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axes = figure.subplots()
    for k, curve in enumerate(found):
        colour, n = f"C{k}", len(curve.seeds)
        axes.plot(curve.steps, curve.seeds.T, color=colour, linewidth=0.5, alpha=0.5)
        label = f"{curve.name} ({n} seed{'s' * (n != 1)})"
        axes.plot(curve.steps, curve.mean, color=colour, linewidth=1.8, label=label)
        if n > 1:
            low, high = curve.mean - curve.reach, curve.mean + curve.reach
            axes.fill_between(curve.steps, low, high, color=colour, alpha=0.2, linewidth=0)
    measures = dict.fromkeys(curve.measure for curve in found)
    axes.set(xlabel="steps", ylabel=" / ".join(measures), title="means over seeds, 95 % intervals")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    with replaced(target) as temporary:
        figure.savefig(temporary, format=target.suffix[1:])
    return found


def _of_seed(folder: Path, measure: str | None) -> tuple[str, Numbers]:
    """(measure, float64[points, 2]: steps and values) of one seed."""
    validation, monitor = folder / "validation.csv", sorted(folder.glob("*.monitor.csv"))
    if validation.is_file():
        names, rows = _table(validation, read_utf8(validation, MAX_BYTES))
        known = [name for name in names if name not in ("steps", "seconds")]
        if "steps" not in names or not known:
            raise BufgymError(where(validation, 1, None, "must have a column steps, and a measure"))
        if measure is not None and measure not in known:
            raise unknown("measure", measure, known, place=str(validation))
        chosen = measure or known[-1]
        return chosen, rows[:, [names.index("steps"), names.index(chosen)]]
    if not monitor:
        raise BufgymError(f"{folder}: no validation.csv and no 0.monitor.csv; a seed's folder has one of them")
    if measure not in (None, "return"):
        raise BufgymError(f"measure = {measure!r}: {monitor[0]} has the return alone")
    text = read_utf8(monitor[0], MAX_BYTES).partition("\n")[2]  # its first line is a comment
    names, rows = _table(monitor[0], text)
    if not {"r", "l"} <= set(names):
        raise BufgymError(where(monitor[0], 2, None, "must have the columns r and l"))
    steps = np.cumsum(rows[:, names.index("l")])
    parts = [part for part in np.array_split(np.arange(len(rows)), min(BINS, len(rows))) if len(part)]
    returns = rows[:, names.index("r")]
    return "return", np.array([[steps[part[-1]], returns[part].mean()] for part in parts])


def _table(path: Path, text: str) -> tuple[list[str], Numbers]:
    """The columns' names and the numbers, float64[rows, columns], at least one row."""
    lines = [line for line in csv.reader(io.StringIO(text)) if line]
    try:
        numbers = np.array(lines[1:], np.float64)
    except ValueError:
        raise BufgymError(f"{path}: must hold numbers alone below its head, equally many a line") from None
    if numbers.ndim != 2 or not len(numbers) or numbers.shape[1] != len(lines[0]):
        raise BufgymError(f"{path}: must have a head and at least one line of numbers")
    return lines[0], numbers
