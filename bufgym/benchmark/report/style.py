"""Style of every chart: one colour for each policy, one layout.

Colours are names of CSS variables such as ``var(--ink)``. The page's script replaces them by the light or dark colours
of the style sheet. Chart text may hold HTML, so names are escaped.
"""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Sequence
from typing import Any

Figure = dict[str, Any]
"""A plotly figure, ``data`` and ``layout``, as plain dictionaries."""

FIXED = {"afr": "var(--blue)", "drop-oldest": "var(--vermillion)", "clairvoyant": "var(--ink)"}
"""Policies that look the same in every report."""

SPARE = ("var(--green)", "var(--orange)", "var(--purple)", "var(--sky)")
"""Colours of the best other policies, in order."""

MUTED = "var(--muted)"


def colours(ranked: Sequence[str], baseline: str) -> dict[str, str]:
    """Choose a colour for each highlighted policy: the fixed ones, the baseline and the first of ``ranked``."""
    fixed = dict(FIXED)
    if baseline not in fixed:
        fixed[baseline] = fixed.pop("drop-oldest")
    others = [name for name in ranked if name not in fixed]
    return {**fixed, **dict(zip(others, SPARE, strict=False))}


def text(name: str) -> str:
    """Escape a name so that a chart shows it as written."""
    return html.escape(name, quote=False)


def rounded(entries: Sequence[Any]) -> list[Any]:
    """Round numbers to six digits, enough for a screen; NaN becomes None, and text stays."""
    return [
        e if isinstance(e, str) else None if e is None or not math.isfinite(e) else float(f"{e:.6g}") for e in entries
    ]


def axis(title: str = "", **changes: Any) -> dict[str, Any]:
    """One axis: thin grid, no zero line."""
    return {
        "title": {"text": title, "font": {"size": 13}, "standoff": 8},
        "gridcolor": "var(--grid)",
        "linecolor": "var(--axis)",
        "tickcolor": "var(--axis)",
        "zeroline": False,
        "automargin": True,
        **changes,
    }


def log_axis(
    title: str,
    low: float,
    high: float,
    write: Callable[[float], str],
    steps: Sequence[int] = (1, 2, 5),
    **changes: Any,
) -> dict[str, Any]:
    """A logarithmic axis from ``low`` to ``high`` with ticks at ``steps``, or at powers of ten where it is long."""
    steps = (1,) if high / low > 3000 else steps
    ticks = [m * 10.0**e for e in range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1) for m in steps]
    span = [math.log10(low), math.log10(high)]
    return axis(title, type="log", range=span, tickvals=ticks, ticktext=[write(tick) for tick in ticks], **changes)


def short_percent(share: float) -> str:
    """0.2 % on an axis."""
    return f"{share * 100:g} %"


def layout(height: int, **changes: Any) -> dict[str, Any]:
    """Layout shared by all charts; ``height`` in pixels."""
    hover = {"bgcolor": "var(--panel)", "bordercolor": "var(--axis)", "font": {"color": "var(--ink)", "size": 13}}
    return {
        "template": {},
        "height": height,
        "margin": {"l": 10, "r": 20, "t": 16, "b": 44},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "font": {"family": "system-ui, sans-serif", "size": 12, "color": "var(--ink)"},
        "showlegend": False,
        "hovermode": "closest",
        "hoverlabel": hover,
        "dragmode": "zoom",
        **changes,
    }


def scatter(
    x: Sequence[Any], y: Sequence[Any], hover: str = "", mode: str = "markers", **changes: Any
) -> dict[str, Any]:
    """Points or lines in a chart, with numbers rounded; without hover text they ignore the pointer."""
    answer = {"hovertemplate": f"{hover}<extra></extra>"} if hover else {"hoverinfo": "skip"}
    return {"type": "scatter", "mode": mode, "x": rounded(x), "y": rounded(y), **answer, **changes}


def lanes(names: Sequence[str], grid: bool = False, **changes: Any) -> dict[str, Any]:
    """Layout with one lane for each policy, the last on top; ``grid`` draws a line through each."""
    labels = [text(name) for name in names]
    y = axis(categoryorder="array", categoryarray=labels, tickvals=labels, ticks="", showline=False, showgrid=grid)
    y["range"] = [-0.7, len(names) - 0.3]
    return layout(70 + 20 * max(len(names), 3), yaxis=y, **changes)


def note(words: str, **place: Any) -> dict[str, Any]:
    """An annotation without an arrow."""
    return {"text": words, "showarrow": False, "font": {"size": 12}, **place}


def line(axis: str, at: float) -> dict[str, Any]:
    """A straight line across the whole chart, at ``at`` on the x or y axis."""
    across = "y" if axis == "x" else "x"
    ends = {f"{axis}0": at, f"{axis}1": at, f"{axis}ref": axis}
    whole = {f"{across}0": 0, f"{across}1": 1, f"{across}ref": f"{across} domain"}
    return {"type": "line", "layer": "below", **ends, **whole, "line": {"color": "var(--axis)", "width": 1.5}}
