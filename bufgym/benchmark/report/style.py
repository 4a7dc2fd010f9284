"""How things look in every chart: one colour a policy, one layout, one way to write numbers.

Colours are names of CSS variables (``var(--ink)``); the page's script puts in what the style sheet says for light or
dark. Text in a chart may hold some HTML, so names are escaped on their way in.
"""

from __future__ import annotations

import html
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

Figure = dict[str, Any]
"""A plotly figure, ``data`` and ``layout``, as plain dictionaries."""

FIXED = {"afr": "var(--blue)", "drop-oldest": "var(--vermillion)", "clairvoyant": "var(--ink)"}
"""Policies that look the same in every report."""

SPARE = ("var(--green)", "var(--orange)", "var(--purple)", "var(--sky)")
"""For the best of the others, in their order."""

MUTED = "var(--muted)"


def colours(ranked: Sequence[str]) -> dict[str, str]:
    """A colour for each policy that stands out: the fixed ones and the best of ``ranked`` (best first)."""
    others = [name for name in ranked if name not in FIXED]
    return {**FIXED, **dict(zip(others, SPARE, strict=False))}


def text(name: str) -> str:
    """A name as chart text that shows as it is written."""
    return html.escape(name, quote=False)


def score(number: float) -> str:
    """0.713, or a dash where there is none."""
    return _signed(number, 3)


def percent(number: float) -> str:
    """Three digits: 12.3 %, 1.23 %, 0.123 %."""
    size = float(f"{abs(number * 100):.3g}")  # rounded first: 9.999 % is 10.0 %
    return _signed(number * 100, 1 if size >= 10 else 2 if size >= 1 else 3) + ("" if math.isnan(number) else " %")


def _signed(number: float, digits: int) -> str:
    """A true minus sign, and none before a zero; a dash for NaN."""
    if math.isnan(number):
        return "–"
    written = f"{abs(number):.{digits}f}"
    return f"\N{MINUS SIGN}{written}" if number < 0 and float(written) else written


def rounded(number: float | None) -> float | None:
    """Six digits are enough for a screen; None where there is no number."""
    return None if number is None or not math.isfinite(number) else float(f"{number:.6g}")


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
    """What all charts share; ``height`` in pixels."""
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


def note(words: str, **place: Any) -> dict[str, Any]:
    """An annotation without an arrow."""
    return {"text": words, "showarrow": False, "font": {"size": 12}, **place}


def line(axis: str, at: float) -> dict[str, Any]:
    """A straight line across the whole chart, at ``at`` on the x or y axis."""
    across = "y" if axis == "x" else "x"
    ends = {f"{axis}0": at, f"{axis}1": at, f"{axis}ref": axis}
    whole = {f"{across}0": 0, f"{across}1": 1, f"{across}ref": f"{across} domain"}
    return {"type": "line", "layer": "below", **ends, **whole, "line": {"color": "var(--axis)", "width": 1.5}}


def apart(wanted: Mapping[str, float], gap: float) -> dict[str, float]:
    """Positions at least ``gap`` apart, in the order of the wanted ones and as a whole no higher nor lower."""
    names = sorted(wanted, key=lambda name: wanted[name])
    groups: list[tuple[float, list[str]]] = []  # (centre, names), bottom up; groups that touch become one
    for name in names:
        groups.append((wanted[name], [name]))
        while len(groups) > 1:
            (below, first), (above, second) = groups[-2:]
            if above - below >= gap * (len(first) + len(second)) / 2:
                break
            size = len(first) + len(second)
            groups[-2:] = [((below * len(first) + above * len(second)) / size, first + second)]
    return {
        name: centre + (k - (len(members) - 1) / 2) * gap
        for centre, members in groups
        for k, name in enumerate(members)
    }
