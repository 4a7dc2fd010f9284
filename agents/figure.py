"""The picture of a training run: learning curves on the left, every policy's score on the right."""

import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.benchmark.bootstrap import Interval

_LINES = ("tab:gray", "tab:brown", "tab:green", "tab:olive", "tab:cyan", "tab:blue")
"""Colours of the horizontal lines, in their order."""


def draw(
    path: Path,
    curves: Mapping[str, NDArray[Any]],
    labels: tuple[str, str],
    bars: Mapping[str, Interval],
    title: str,
    *,
    lines: Mapping[str, float] | None = None,
    notes: Sequence[str] = (),
) -> None:
    """Write the picture, if matplotlib is installed.

    Args:
        path: the picture.
        curves: (seconds, measure) of each agent by its name, float[rows, 2].
        labels: of the curves' axes.
        bars: policy -> score, best first.
        title: the episodes of the scores.
        lines: values of fixed policies in the curves' measure.
        notes: lines below the bars.
    """
    if importlib.util.find_spec("matplotlib") is None:
        print("no figure: matplotlib is not installed")
        return
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4.4 + 0.16 * max(0, len(bars) - 14)), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    for name, curve in curves.items():
        style = "x:" if "agent by" in name else "o-"
        left.plot(*curve.T, style, markersize=3, color=None if len(curves) > 2 else "tab:orange", label=name)
    for (name, level), colour in zip((lines or {}).items(), _LINES, strict=False):
        left.axhline(level, color=colour, linestyle="--", linewidth=1, label=f"{name} {level:.3f}")
    left.set(xlabel=labels[0], ylabel=labels[1], title="Training")
    left.set_xlim(left=0)
    left.grid(alpha=0.3)
    left.legend(frameon=False)
    names, intervals = list(bars)[::-1], list(bars.values())[::-1]
    scores = np.array([interval.value for interval in intervals])
    reach = np.array([[s - i.low, i.high - s] for s, i in zip(scores, intervals, strict=True)]).reshape(-1, 2)
    colours = ["tab:orange" if name.startswith("agent") else "tab:blue" for name in names]
    whiskers = {"ecolor": "0.25", "elinewidth": 1, "capsize": 2}
    right.barh(names, scores, xerr=np.nan_to_num(reach).clip(0).T, color=colours, error_kw=whiskers)
    for name, interval in zip(names, intervals, strict=True):
        end = min(max(interval.value, np.nan_to_num(interval.high)), 1.0)  # of few links it can lie far outside
        right.text(end + 0.01, name, f"{interval.value:.3f}", va="center")
    right.set(xlabel="\n".join(["score: 0 is Drop Oldest, 1 the clairvoyant", *notes]), title=title, xlim=(0, 1))
    right.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=120)
