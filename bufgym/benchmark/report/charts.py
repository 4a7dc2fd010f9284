"""Charts as plain dictionaries for plotly; every statistic in them comes from the summary."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bufgym.benchmark.bootstrap import Interval, written
from bufgym.benchmark.folder import SuiteRun
from bufgym.benchmark.report import style
from bufgym.benchmark.report.style import Figure
from bufgym.benchmark.score import CellScore
from bufgym.benchmark.summary import Quantity, Summary
from bufgym.benchmark.table import REGRET_AT_MOST, means, percent


@dataclass(frozen=True)
class Chart:
    """A chart on the page."""

    id: str  # of its section
    alt: str  # text for readers who can't see it
    choices: list[tuple[str, list[str]]]  # (label, options), the default option first
    panels: Mapping[tuple[str, ...], list[Figure]]  # one option of each choice -> figures shown side by side


@dataclass(frozen=True)
class Context:
    """Input of every chart."""

    run: SuiteRun
    summary: Summary
    colours: dict[str, str]  # of highlighted policies

    @classmethod
    def of(cls, run: SuiteRun, summary: Summary) -> Context:
        ranked = [standing.policy for standing in summary.overall if standing.ranked]
        return cls(run, summary, style.colours(ranked, summary.baseline))

    @property
    def cells(self) -> list[CellScore]:
        """Scores of every cell; empty without scores."""
        return [] if self.summary.scores is None else self.summary.scores.cells

    def colour(self, policy: str) -> str:
        return self.colours.get(policy, style.MUTED)

    def order(self, policies: Sequence[str]) -> list[str]:
        """Put muted policies first, so that highlighted ones are drawn on top."""
        return sorted(policies, key=lambda name: name in self.colours)


def with_interval(value: Interval, write: Callable[[float], str]) -> str:
    """Format value and interval."""
    return " ".join(filter(None, written(value, write)))


# --- ranking ---------------------------------------------------------------------------------------------------------


def ranking(context: Context) -> Chart | None:
    """Draw a dot and an interval for each policy; None if no policy has a value of the ranking quantity."""
    quantities = {quantity.key: quantity for quantity in context.summary.quantities}
    if not _known(context, quantities[context.summary.rank_by]):
        return None
    panels = [
        _dots(context, quantity, quantities.get("iqm") if quantity.key == "score" else None)
        for quantity in quantities.values()
        if quantity.drawn and _known(context, quantity)
    ]
    alt = "Each policy's place in the ranking with intervals; the numbers are in the table above"
    return Chart("ranking", alt, [], {(): panels})


def _known(context: Context, quantity: Quantity) -> dict[str, Interval]:
    """Select policies with a value; an unknown interval becomes that point."""
    values = {standing.policy: standing[quantity.key] for standing in context.summary.overall}
    return {
        policy: Interval(value, *((value, value) if math.isnan(low) else (low, high)))
        for policy, (value, low, high) in values.items()
        if not math.isnan(value)
    }


def _dots(context: Context, quantity: Quantity, second: Quantity | None) -> Figure:
    """Draw one lane for each policy, with a tick for a second quantity. A line marks the baseline.

    Values more than two interquartile ranges beyond the quartiles are written at the edge.
    """
    known, standings = _known(context, quantity), context.summary.standings
    first, third = np.percentile([value for value, *_ in known.values()], [25, 75]).tolist()
    floor, ceiling = first - 2 * (third - first) - 1e-3, third + 2 * (third - first) + 1e-3
    inside = [interval for interval in known.values() if floor <= interval.value <= ceiling]
    low, high = min(interval.low for interval in inside), max(interval.high for interval in inside)
    low, high = low - 0.04 * (high - low) - 1e-6, high + 0.04 * (high - low) + 1e-6
    data, notes = [], []
    for policy, interval in known.items():
        value, colour, name = interval.value, context.colour(policy), style.text(policy)
        if interval not in inside:
            edge: dict[str, Any] = {"x": low, "xanchor": "left", "xshift": 2}
            if value > ceiling:
                edge = {"x": high, "xanchor": "right", "xshift": -2}
            words = f"{quantity.write(value)} ▸" if value > ceiling else f"◂ {quantity.write(value)}"
            notes.append(style.note(words, y=name, **edge))
            continue
        symbol = "circle" if standings[policy].ranked else "circle-open"
        bars = {"type": "data", "symmetric": False, "color": colour, "thickness": 2, "width": 0}
        bars |= {"array": [interval.high - value], "arrayminus": [value - interval.low]}
        hover = f"<b>%{{y}}</b><br>{quantity.title} {with_interval(interval, quantity.write)}"
        marker: dict[str, Any] = {"color": colour, "size": 9, "symbol": symbol}
        data.append(style.scatter([value], [name], hover, marker=marker, error_x=bars))
        if second is not None and not math.isnan(standings[policy][second.key].value):
            beside = standings[policy][second.key]
            hover = f"<b>%{{y}}</b><br>{second.title} {with_interval(beside, second.write)}"
            marker = {"color": colour, "size": 8, "symbol": "line-ns-open", "line": {"width": 1.5}}
            data.append(style.scatter([beside.value], [name], hover, marker=marker))
    axis = style.axis(quantity.title, range=[low, high], nticks=7)
    if quantity.write is percent:
        axis["tickformat"] = ".0%"
    layout = style.lanes(list(reversed(known)), xaxis=axis, annotations=notes)
    compared = known.get(quantity.versus or context.summary.baseline)
    layout["shapes"] = [] if compared is None else [style.line("x", compared.value)]
    return {"data": data, "layout": layout}


# --- regret against something -----------------------------------------------------------------------------------------


def capacities(context: Context) -> Chart | None:
    """Draw regret against L for one scenario at a time; None with a single capacity."""
    cells = context.cells
    if len({cell.capacity for cell in cells}) < 2:
        return None
    x = {"title": "capacity L, messages", "type": "log"}
    panels: dict[tuple[str, ...], list[Figure]] = {}
    for scenario in dict.fromkeys(cell.scenario for cell in cells):
        curves = _curves([c for c in cells if c.scenario == scenario], lambda c: float(c.capacity))
        if curves:
            panels[(scenario,)] = [_regret_curves(context, curves, x)]
    if not panels:
        return None
    alt = "Regret of each policy against the capacity L, with intervals"
    return Chart("capacities", alt, [("Scenario", [scenario for (scenario,) in panels])], panels)


def outages(context: Context) -> Chart | None:
    """Draw regret against the outage's length for each V and capacity; None with fewer than two lengths."""
    scenarios = context.run.manifest["scenarios"]
    lengths = {name: float(s["outage_s"]) for name, s in scenarios.items() if s.get("outage_s") is not None}
    cells = [cell for cell in context.cells if cell.scenario in lengths]
    panels: dict[tuple[str, ...], list[Figure]] = {}
    values = list(dict.fromkeys(str(scenarios[cell.scenario].get("value", "")) for cell in cells))
    sizes = middle_first({cell.capacity for cell in cells})
    x = {"title": "length of the outage, s", "type": "log"}
    for value in values:
        same = [c for c in cells if str(scenarios[c.scenario].get("value", "")) == value]
        for capacity in sizes:
            curves = _curves([c for c in same if c.capacity == capacity], lambda c: lengths[c.scenario])
            panels[(value, str(capacity))] = [_regret_curves(context, curves, x)] if curves else []
    if len({lengths[cell.scenario] for cell in cells}) < 2 or not any(panels.values()):
        return None
    choices = [("Value of a step", values), ("Capacity L", [str(size) for size in sizes])]
    return Chart("outages", "Regret of each policy against the length of the outage, with intervals", choices, panels)


Curve = list[tuple[float, CellScore]]
"""(position on the axis, cell), from left to right."""


def _curves(cells: Sequence[CellScore], at: Callable[[CellScore], float]) -> dict[str, Curve]:
    """Group the cells by policy; cells without a regret are left out."""
    curves: dict[str, Curve] = {}
    for cell in sorted(cells, key=at):
        if not math.isnan(cell.regret.value):
            curves.setdefault(cell.policy, []).append((at(cell), cell))
    return curves


def _regret_curves(context: Context, curves: dict[str, Curve], x: dict[str, Any]) -> Figure:
    """Draw lines and bands; the legend names highlighted lines."""
    low, high = regret_range([cell.regret.value for curve in curves.values() for _, cell in curve])
    data: list[dict[str, Any]] = []
    for policy in context.order(list(curves)):
        curve, colour, out = curves[policy], context.colour(policy), policy in context.colours
        xs = [at for at, _ in curve]
        if out:
            band = [c.regret.low for _, c in curve] + [c.regret.high for _, c in curve][::-1]
            area: dict[str, Any] = {"fill": "toself", "fillcolor": colour, "opacity": 0.16, "line": {"width": 0}}
            bounds = [max(y, low) for y in band]
            data.append(style.scatter(xs + xs[::-1], bounds, mode="lines", showlegend=False, **area))
        data.append(
            style.scatter(
                xs,
                [max(c.regret.value, low) for _, c in curve],
                "<b>%{fullData.name}</b>, %{x}<br>regret %{text}",
                mode="lines+markers",
                cliponaxis=False,
                name=style.text(policy),
                showlegend=out,
                line={"color": colour, "width": 2 if out else 1, "dash": "dot" if policy == "clairvoyant" else "solid"},
                opacity=1 if out else 0.55,
                marker={"size": 6 if out else 4, "color": colour},
                text=[
                    f"{with_interval(c.regret, percent)}<br>QoI {with_interval(c.qoi, '{:.2f}'.format)}"
                    for _, c in curve
                ],
            )
        )
    ticks = sorted({at for curve in curves.values() for at, _ in curve})
    across = style.axis(**x, showgrid=False, tickvals=ticks, ticktext=[f"{tick:g}" for tick in ticks])
    across["range"] = [math.log10(ticks[0]) - 0.03, math.log10(ticks[-1]) + 0.03]
    title = regret_title(cell for curve in curves.values() for _, cell in curve)
    up = style.log_axis(title, low, high, style.short_percent)
    return {"data": data, "layout": style.layout(430, xaxis=across, yaxis=up, showlegend=True)}


def regret_title(cells: Iterable[CellScore]) -> str:
    """The title of an axis of regrets."""
    return "regret" if all(cell.exact for cell in cells) else REGRET_AT_MOST


def regret_range(regrets: Sequence[float]) -> tuple[float, float]:
    """Ends of a logarithmic axis; regrets below 1/10,000, such as the clairvoyant's 0, sit on the lower edge."""
    positive = [regret for regret in regrets if regret > 1e-4]
    if not positive:
        return 1e-4, 1.0
    return min(positive) / 1.4, min(max(positive) * 1.4, 1.0)


def middle_first(sizes: set[int]) -> list[int]:
    """Sort the sizes in ascending order, but put the middle one first, as the default to show."""
    ordered = sorted(sizes)
    middle = ordered[len(ordered) // 2 : len(ordered) // 2 + 1]
    return middle + [size for size in ordered if size not in middle]


# --- costs besides information: delay at the sender, age at the server ------------------------------------------------

LONG = 8.0
"""Ratio of largest to smallest value from which an axis is logarithmic."""


def delays(context: Context) -> Chart | None:
    """Regret, sojourn time and age of information side by side, for each scenario and capacity."""
    cells: dict[tuple[str, int], dict[str, CellScore]] = {}
    for cell in context.cells:
        if not math.isnan(cell.regret.value):
            cells.setdefault((cell.scenario, cell.capacity), {})[cell.policy] = cell
    if not cells:
        return None
    scenarios = list(dict.fromkeys(scenario for scenario, _ in cells))
    sizes = middle_first({capacity for _, capacity in cells})
    panels: dict[tuple[str, ...], list[Figure]] = {}
    for scenario in scenarios:
        entries = means([row for row in context.run.rows if row["scenario"] == scenario])
        for capacity in sizes:
            scored = cells.get((scenario, capacity), {})
            by_policy = {m["policy"]: m for m in entries if m["capacity"] == capacity and m["policy"] in scored}
            panels[scenario, str(capacity)] = [_three(context, scored, by_policy)] if by_policy else []
    choices = [("Scenario", scenarios), ("Capacity L", [str(size) for size in sizes])]
    alt = "Regret, mean sojourn time and mean age of information of each policy"
    return Chart("delays", alt, choices, panels)


def _three(context: Context, cells: Mapping[str, CellScore], entries: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Three columns of dots over the same lanes, least regret on top."""
    names = sorted(entries, key=lambda name: cells[name].regret.value, reverse=True)
    data: list[dict[str, Any]] = []

    def column(values: Sequence[float], title: str, words: Sequence[str]) -> None:
        data.append(
            style.scatter(
                values,
                [style.text(name) for name in names],
                f"<b>%{{y}}</b><br>{title} %{{text}}",
                cliponaxis=False,
                xaxis=f"x{len(data) + 1}" if data else "x",
                marker={"color": [context.colour(name) for name in names], "size": 9},
                text=list(words),
            )
        )

    low, high = regret_range([cells[name].regret.value for name in names])
    regrets = [max(cells[name].regret.value, low) for name in names]
    measure = regret_title(cells[name] for name in names)
    column(regrets, measure, [with_interval(cells[name].regret, percent) for name in names])
    place = {"domain": [0, 0.31], "tickangle": 0}
    axes = {"xaxis": style.log_axis(measure, low / 1.15, high, style.short_percent, (1, 3), **place)}
    for key, title, start in (
        ("mean_sojourn_s", "mean sojourn time", 0.345),
        ("mean_age_s", "mean age of information", 0.69),
    ):
        values = [entries[name][key] for name in names]
        column(values, title, [f"{value:.3g} s" for value in values])
        place = {"domain": [start, start + 0.31], "tickangle": 0}
        axes[f"xaxis{len(data)}"] = _seconds_axis(f"{title}, s", values, **place)
    return {"data": data, "layout": style.lanes(names, grid=True, **axes)}


def _seconds_axis(title: str, values: Sequence[float], **changes: Any) -> dict[str, Any]:
    positive = [value for value in values if value > 0]  # NaN where nothing was delivered
    if positive and max(positive) / min(positive) >= LONG:
        return style.log_axis(title, min(positive) / 1.3, max(positive) * 1.3, "{:g}".format, **changes)
    return style.axis(title, rangemode="tozero", nticks=6, **changes)
