"""Charts of the report, drawn by matplotlib as SVG for the page; every statistic in them comes from the summary."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bufgym.benchmark.bootstrap import Interval
from bufgym.benchmark.folder import SuiteRun
from bufgym.benchmark.score import CellScore
from bufgym.benchmark.summary import Quantity, Summary
from bufgym.benchmark.table import REGRET_AT_MOST, means, percent
from bufgym.utils.libraries import library

PALETTE = {
    **{"ink": "#1b1f24", "grid": "#e7eaee", "axis": "#a3abb5", "muted": "#a2aab4"},
    **{"blue": "#0072b2", "vermillion": "#d55e00", "green": "#009e73"},
    **{"orange": "#c98500", "purple": "#b9568f", "sky": "#3f9fd6", "link": "#6b7681"},
}
"""Name of the style sheet's colour -> the light colour, which charts are drawn in. The page has the name in its place,
so that a chart is light or dark with the page."""

FIXED = {"afr": "blue", "drop-oldest": "vermillion", "clairvoyant": "ink"}
"""Policies that look the same in every report."""

SPARE = ("green", "orange", "purple", "sky")  # Colours of the best other policies, in order

STYLE: dict[Any, Any] = {
    **{"svg.fonttype": "none", "svg.hashsalt": "bufgym", "text.parse_math": False, "font.size": 9},
    **dict.fromkeys(("text.color", "axes.labelcolor", "xtick.labelcolor", "ytick.labelcolor"), PALETTE["ink"]),
    **dict.fromkeys(("axes.edgecolor", "xtick.color", "ytick.color"), PALETTE["axis"]),
    **{"axes.spines.top": False, "axes.spines.right": False, "axes.axisbelow": True},
    **{"axes.grid": True, "grid.color": PALETTE["grid"], "legend.frameon": False},
}


@dataclass(frozen=True)
class Chart:
    id: str  # of its section
    alt: str  # text for readers who can't see it
    panels: list[tuple[str, str]]  # (what it is of, or nothing for a single one, SVG)


@dataclass(frozen=True)
class Context:
    run: SuiteRun
    summary: Summary
    colours: dict[str, str]  # names of highlighted policies' colours

    @classmethod
    def of(cls, run: SuiteRun, summary: Summary) -> Context:
        fixed = dict(FIXED)
        if summary.baseline not in fixed:
            fixed[summary.baseline] = fixed.pop("drop-oldest")
        others = [s.policy for s in summary.overall if s.ranked and s.policy not in fixed]
        return cls(run, summary, {**fixed, **dict(zip(others, SPARE, strict=False))})

    @property
    def cells(self) -> list[CellScore]:
        """Scores of every cell whose regret is known; empty without scores."""
        cells = [] if self.summary.scores is None else self.summary.scores.cells
        return [cell for cell in cells if not math.isnan(cell.regret.value)]

    def colour(self, policy: str) -> str:
        return self.colours.get(policy, "muted")

    def paint(self, policy: str) -> str:
        return PALETTE[self.colour(policy)]


def svg(draw: Callable[[Any], None], height: float) -> str:
    """Let ``draw`` fill a figure of 9 by ``height`` inches; return it as an SVG element."""
    matplotlib, figures = (library(name, "report", "the report") for name in ("matplotlib", "matplotlib.figure"))
    out = io.StringIO()
    with matplotlib.rc_context(STYLE):
        figure = figures.Figure((9, height), layout="constrained")
        draw(figure)
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(out, format="svg", transparent=True, metadata=nothing)
    names = {colour: name for name, colour in PALETTE.items()}
    text = out.getvalue()
    return re.sub(
        r"(fill|stroke): (#[0-9a-f]{6})",
        lambda found: f"{found[1]}: var(--{names[found[2]]})" if found[2] in names else found[0],
        text[text.index("<svg") :],
    )


def set_lanes(axes: Any, names: Sequence[str]) -> None:
    """One lane for each policy, the last on top."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(-0.7, len(names) - 0.3)
    axes.tick_params(axis="y", length=0)


def _lanes_height(names: Sequence[str]) -> float:
    return 0.8 + 0.2 * max(len(names), 3)


def ranking(context: Context) -> Chart | None:
    """Draw a dot and an interval for each policy; None if no policy has a value of the ranking quantity."""
    quantities = {quantity.key: quantity for quantity in context.summary.quantities}
    if not _with_a_value(context, quantities[context.summary.rank_by]):
        return None
    shown = [quantity for quantity in quantities.values() if quantity.drawn and _with_a_value(context, quantity)]
    names = [standing.policy for standing in reversed(context.summary.overall)]

    def draw(figure: Any) -> None:
        for axes, quantity in zip(figure.subplots(1, len(shown), squeeze=False, sharey=True)[0], shown, strict=True):
            _dots(context, axes, names, quantity, "iqm" if quantity.key == "score" else None)

    alt = "Each policy's place in the ranking with intervals; the numbers are in the table above"
    return Chart("ranking", alt, [("", svg(draw, _lanes_height(names)))])


def _with_a_value(context: Context, quantity: Quantity) -> dict[str, Interval]:
    """Select policies with a value; an unknown interval becomes that point."""
    values = {standing.policy: standing[quantity.key] for standing in context.summary.overall}
    return {
        policy: Interval(value, *((value, value) if math.isnan(low) else (low, high)))
        for policy, (value, low, high) in values.items()
        if not math.isnan(value)
    }


def _dots(context: Context, axes: Any, names: list[str], quantity: Quantity, second: str | None) -> None:
    """Draw one lane for each policy, with a tick for a second quantity. A line marks the baseline.

    Values more than two interquartile ranges beyond the quartiles are written at the edge.
    """
    with_value, standings = _with_a_value(context, quantity), context.summary.standings
    first, third = np.percentile([value for value, *_ in with_value.values()], [25, 75]).tolist()
    floor, ceiling = first - 2 * (third - first) - 1e-3, third + 2 * (third - first) + 1e-3
    for policy, (value, low, high) in with_value.items():
        lane, colour = names.index(policy), context.paint(policy)
        if not floor <= value <= ceiling:
            words = f"{quantity.write(value)} ▸" if value > ceiling else f"◂ {quantity.write(value)}"
            place: dict[str, Any] = {"x": 0, "ha": "left"} if value < floor else {"x": 1, "ha": "right"}
            axes.text(y=lane, s=words, va="center", transform=axes.get_yaxis_transform(), **place)
            continue
        face = colour if standings[policy].ranked else "none"
        axes.plot([low, high], [lane, lane], color=colour, linewidth=2)
        axes.plot(value, lane, "o", color=colour, markerfacecolor=face)
        if second is not None and not math.isnan(standings[policy][second].value):
            axes.plot(standings[policy][second].value, lane, "|", color=colour, markersize=8)
    axes.set_xlabel(quantity.title)
    if quantity.write is percent:
        axes.xaxis.set_major_formatter("{x:.0%}")
    set_lanes(axes, names)
    compared = with_value.get(quantity.versus or context.summary.baseline)
    if compared is not None:
        axes.axvline(compared.value, color=PALETTE["axis"], zorder=0.5)


def capacities(context: Context) -> Chart | None:
    """Draw regret against L for each scenario; None with a single capacity."""
    alt = "Regret of each policy against the capacity L, with intervals"
    return _against(context, "capacities", alt, "capacity L, messages", lambda c: c.scenario, lambda c: c.capacity)


def outages(context: Context) -> Chart | None:
    """Draw regret against the outage's length for each V and capacity; None with fewer than two lengths."""
    scenarios = context.run.manifest["scenarios"]
    lengths = {name: float(s["outage_s"]) for name, s in scenarios.items() if s.get("outage_s") is not None}
    return _against(
        context,
        "outages",
        "Regret of each policy against the length of the outage, with intervals",
        "length of the outage, s",
        lambda cell: f"V = {scenarios[cell.scenario].get('value', '')}, L = {cell.capacity}",
        lambda cell: lengths.get(cell.scenario, math.nan),
    )


def _against(
    context: Context,
    id: str,
    alt: str,
    title: str,
    panel_of: Callable[[CellScore], str],
    at: Callable[[CellScore], float],
) -> Chart | None:
    """Draw regret against ``at``, a panel for each ``panel_of``; None with fewer than two places on the axis."""
    cells = [cell for cell in context.cells if not math.isnan(at(cell))]
    if len({at(cell) for cell in cells}) < 2:
        return None
    panels: dict[str, dict[str, list[CellScore]]] = {}
    for cell in sorted(cells, key=at):
        panels.setdefault(panel_of(cell), {}).setdefault(cell.policy, []).append(cell)
    order = dict.fromkeys(map(panel_of, cells))  # of the manifest
    return Chart(id, alt, [(name, _regret_curves(context, panels[name], title, at)) for name in order])


def _regret_curves(
    context: Context, curves: Mapping[str, Sequence[CellScore]], title: str, at: Callable[[CellScore], float]
) -> str:
    """Draw lines and bands, highlighted policies on top; the legend names these."""
    cells = [cell for curve in curves.values() for cell in curve]
    low, high = regret_range([cell.regret.value for cell in cells])

    def draw(figure: Any) -> None:
        axes = figure.subplots()
        axes.set_xscale("log")
        for policy in sorted(curves, key=lambda name: name in context.colours):
            colour, out = context.paint(policy), policy in context.colours
            xs = [at(cell) for cell in curves[policy]]
            value, bottom, top = (
                np.maximum(part, low) for part in zip(*(c.regret for c in curves[policy]), strict=True)
            )
            if out:
                axes.fill_between(xs, bottom, top, color=colour, alpha=0.16, linewidth=0)
            dash = ":" if policy == "clairvoyant" else "-"
            label = policy if out else None
            axes.plot(
                xs, value, dash, marker=".", color=colour, linewidth=2 if out else 0.8, label=label, clip_on=False
            )
        ticks = sorted({at(cell) for cell in cells})
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.xaxis.minorticks_off()
        axes.grid(visible=False, axis="x")
        axes.set_xlabel(title)
        _log_axis(axes, "y", low, high, regret_title(cells), short_percent)
        axes.legend(loc="upper left", bbox_to_anchor=(1, 1))

    return svg(draw, 4.2)


def regret_title(cells: Iterable[CellScore]) -> str:
    """The heading of regret, which says "at most" where a bound of a cell is not exact."""
    return "regret" if all(cell.exact for cell in cells) else REGRET_AT_MOST


def regret_range(regrets: Sequence[float]) -> tuple[float, float]:
    """Ends of a logarithmic axis; regrets below 1/10,000, such as the clairvoyant's 0, sit on the lower edge."""
    positive = [regret for regret in regrets if regret > 1e-4]
    if not positive:
        return 1e-4, 1.0
    return min(positive) / 1.4, min(max(positive) * 1.4, 1.0)


def short_percent(share: float) -> str:
    """0.2 % on an axis."""
    return f"{share * 100:g} %"


def _log_axis(axes: Any, side: str, low: float, high: float, title: str, write: Callable[[float], str]) -> None:
    """Make an axis logarithmic, with ticks at 1, 2 and 5, or at powers of ten where it is long."""
    steps = (1,) if high / low > 3000 else (1, 2, 5)
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = [tick for tick in (m * 10.0**e for e in powers for m in steps) if low <= tick <= high]
    axes.set(**{f"{side}scale": "log", f"{side}lim": (low, high), f"{side}label": title})
    axes.set(**{f"{side}ticks": ticks, f"{side}ticklabels": [write(tick) for tick in ticks]})
    axes.tick_params(axis=side, which="minor", length=0, labelbottom=False, labelleft=False)


LONG = 8.0  # Ratio of largest to smallest value from which an axis is logarithmic


def delays(context: Context) -> Chart | None:
    """Regret, sojourn time and age of information side by side, for each scenario at the middle capacity."""
    sizes = sorted({cell.capacity for cell in context.cells})
    scenarios: dict[str, dict[str, CellScore]] = {}
    for cell in context.cells:
        if cell.capacity == sizes[len(sizes) // 2]:
            scenarios.setdefault(cell.scenario, {})[cell.policy] = cell
    panels = []
    for scenario, cells in scenarios.items():
        capacity = sizes[len(sizes) // 2]
        rows = [row for row in context.run.rows if (row["scenario"], row["capacity"]) == (scenario, capacity)]
        panels.append((f"{scenario}, L = {capacity}", _three(context, cells, means(rows))))
    alt = "Regret, mean sojourn time and mean age of information of each policy"
    return Chart("delays", alt, panels) if panels else None


def _three(context: Context, cells: Mapping[str, CellScore], entries: Sequence[Mapping[str, Any]]) -> str:
    """Three columns of dots over the same lanes, least regret on top."""
    names = sorted(cells, key=lambda name: cells[name].regret.value, reverse=True)
    by_policy = {entry["policy"]: entry for entry in entries}
    low, high = regret_range([cell.regret.value for cell in cells.values()])
    columns = [(regret_title(cells.values()), [max(cells[name].regret.value, low) for name in names])]
    for key, title in ("mean_sojourn_s", "mean sojourn time, s"), ("mean_age_s", "mean age of information, s"):
        columns.append((title, [by_policy[name][key] for name in names]))

    def draw(figure: Any) -> None:
        for k, axes in enumerate(figure.subplots(1, 3, sharey=True)):
            title, values = columns[k]
            axes.scatter(values, range(len(names)), color=[context.paint(name) for name in names], clip_on=False)
            positive = [value for value in values if value > 0]  # NaN where nothing was delivered
            if k == 0:
                _log_axis(axes, "x", low / 1.15, high, title, short_percent)
            elif positive and max(positive) / min(positive) >= LONG:
                _log_axis(axes, "x", min(positive) / 1.3, max(positive) * 1.3, title, "{:g}".format)
            else:
                axes.set(xlabel=title, xlim=(0, 1.1 * max(positive, default=1)))
            set_lanes(axes, names)

    return svg(draw, _lanes_height(names))
