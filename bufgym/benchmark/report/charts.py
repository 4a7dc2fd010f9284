"""The charts, each a ``Chart`` of plain dictionaries that plotly draws; every statistic in them is the summary's."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bufgym.benchmark.bootstrap import Interval, written
from bufgym.benchmark.folder import Run
from bufgym.benchmark.report import style
from bufgym.benchmark.report.style import Figure
from bufgym.benchmark.score import CellScore
from bufgym.benchmark.summary import Quantity, Standing, Summary
from bufgym.benchmark.table import percent


@dataclass(frozen=True)
class Chart:
    """One place on the page."""

    id: str
    """Of its section."""
    alt: str
    """What it shows, for those who can't see it."""
    choices: list[tuple[str, list[str]]]
    """What can be chosen: (label, options), the first option first."""
    panels: Mapping[tuple[str, ...], list[Figure]]
    """By one option of each choice: the figures that stand side by side."""


@dataclass(frozen=True)
class Context:
    """What every chart is made from."""

    run: Run
    """The run."""
    summary: Summary
    """What its rows say."""
    colours: dict[str, str]
    """By policy, for those that stand out."""

    @classmethod
    def of(cls, run: Run, summary: Summary) -> Context:
        ranked = [standing.policy for standing in summary.overall if standing.ranked]
        return cls(run, summary, style.colours(ranked, summary.baseline))

    @property
    def cells(self) -> list[CellScore]:
        """Scores of every cell; none where there are no scores."""
        return [] if self.summary.scores is None else self.summary.scores.cells

    def colour(self, policy: str) -> str:
        return self.colours.get(policy, style.MUTED)

    def order(self, policies: Sequence[str]) -> list[str]:
        """Muted ones first, so that the others are drawn on top of them."""
        return sorted(policies, key=lambda name: name in self.colours)


def with_interval(value: Interval, write: Callable[[float], str]) -> str:
    """Both as text."""
    return " ".join(filter(None, written(value, write)))


# --- ranking ---------------------------------------------------------------------------------------------------------


def ranking(context: Context) -> Chart | None:
    """A dot and an interval for each policy, by the quantities that matter; None where no policy has a value."""
    summary = context.summary
    quantities = {quantity.key: quantity for quantity in summary.quantities}
    if summary.scores is None:
        panels = _summary_panels(context)
    else:
        shown = quantities["score"], quantities["improvement"]
        panels = [
            _dots(context, shown[0], (0, 1), (-1.0, 1.05, 2.1), quantities["iqm"]),
            _dots(context, shown[1], (0.5,), (-1.0, 1.0, 2.0)),
        ]
        panels = [panel for panel, quantity in zip(panels, shown, strict=True) if _known(summary, quantity)]
    if not _known(summary, quantities[summary.rank_by]):
        return None
    alt = "Each policy's place in the ranking with intervals; the numbers are in the table above"
    return Chart("ranking", alt, [], {(): panels})


def _summary_panels(context: Context) -> list[Figure]:
    """The two quantities with intervals that come first; a line marks the baseline."""
    figures = []
    for quantity in [q for q in context.summary.quantities if q.interval][:2]:
        values = [s[quantity.key].value for s in _known(context.summary, quantity)]
        # What lies far out is written at the edge, or the others could not be told apart.
        low, high = np.percentile(values, [25, 75]) if values else (0.0, 1.0)
        spread = 4 * max(high - low, 1e-3)
        near = [value for value in values if low - spread <= value <= high + spread] or [0.0]
        base = context.summary.standings[context.summary.baseline][quantity.key].value
        limits = float(low - spread), max(near), float(high + spread)
        figures.append(_dots(context, quantity, (base,), limits, start=min(near)))
    return figures


def _known(summary: Summary, quantity: Quantity) -> list[Standing]:
    """Those that have a value."""
    return [standing for standing in summary.overall if not math.isnan(standing[quantity.key].value)]


def _dots(
    context: Context,
    quantity: Quantity,
    lines: Sequence[float],
    limits: tuple[float, float, float],
    second: Quantity | None = None,
    start: float = 0.0,
) -> Figure:
    """One lane for each policy. ``limits``: what is below the first or above the last is written at the edge; the axis
    reaches from ``start`` at least to the second."""
    floor, high, ceiling = limits
    shown = _known(context.summary, quantity)
    inside = [s[quantity.key] for s in shown if s[quantity.key].high >= floor and s[quantity.key].low <= ceiling]
    inside += [value._replace(low=value.value, high=value.value) for value in inside if math.isnan(value.low)]
    margin = 0.04 * max(high - start, 1e-3)
    low = min([value.low for value in inside if not math.isnan(value.low)] + [start]) - margin
    high = max([value.high + margin for value in inside if not math.isnan(value.high)] + [high + margin / 4])
    data, notes = [], []
    for s in shown:
        value, colour, name = s[quantity.key], context.colour(s.policy), style.text(s.policy)
        if value.high < floor or value.value < floor:
            notes.append(style.note(f"◂ {quantity.write(value.value)}", x=low, y=name, xanchor="left", xshift=2))
            continue
        if value.low > ceiling or value.value > ceiling:
            notes.append(style.note(f"{quantity.write(value.value)} ▸", x=high, y=name, xanchor="right", xshift=-2))
            continue
        arms = [0.0 if math.isnan(arm) else arm for arm in (value.high - value.value, value.value - value.low)]
        bars = {"type": "data", "symmetric": False, "array": arms[:1], "arrayminus": arms[1:], "color": colour}
        hover = f"<b>%{{y}}</b><br>{quantity.title} {with_interval(value, quantity.write)}"
        symbol = "circle" if s.ranked else "circle-open"
        marker: dict[str, Any] = {"color": colour, "size": 9, "symbol": symbol}
        data.append(
            style.scatter([value.value], [name], hover, marker=marker, error_x={**bars, "thickness": 2, "width": 0})
        )
        if second is not None and not math.isnan(s[second.key].value):
            hover = f"<b>%{{y}}</b><br>{second.title} {with_interval(s[second.key], second.write)}"
            marker = {"color": colour, "size": 8, "symbol": "line-ns-open", "line": {"width": 1.5}}
            data.append(style.scatter([s[second.key].value], [name], hover, marker=marker))
    axis = style.axis(quantity.title, range=[low, high], nticks=7)
    if quantity.write is percent:
        axis["tickformat"] = ".0%"
    layout = style.lanes([s.policy for s in reversed(shown)], xaxis=axis, annotations=notes)
    layout["shapes"] = [style.line("x", at) for at in lines]
    return {"data": data, "layout": layout}


# --- regret against something -----------------------------------------------------------------------------------------


def capacities(context: Context) -> Chart | None:
    """Regret against L, a scenario at a time; None where there is but one capacity."""
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
    """Regret against the length of the one outage, for each V and capacity; None with fewer than two lengths."""
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
    """By policy; cells without a regret are left out."""
    curves: dict[str, Curve] = {}
    for cell in sorted(cells, key=at):
        if not math.isnan(cell.regret.value):
            curves.setdefault(cell.policy, []).append((at(cell), cell))
    return curves


def _regret_curves(context: Context, curves: dict[str, Curve], x: dict[str, Any]) -> Figure:
    """Lines and bands; those that stand out are labelled at their right end."""
    low, high = regret_range([cell.regret.value for curve in curves.values() for _, cell in curve])
    data: list[dict[str, Any]] = []
    for policy in context.order(list(curves)):
        curve, colour, out = curves[policy], context.colour(policy), policy in context.colours
        xs = [at for at, _ in curve]
        if out:
            band = [c.regret.low for _, c in curve] + [c.regret.high for _, c in curve][::-1]
            area: dict[str, Any] = {"fill": "toself", "fillcolor": colour, "opacity": 0.16, "line": {"width": 0}}
            data.append(style.scatter(xs + xs[::-1], [max(y, low) for y in band], mode="lines", **area))
        data.append(
            style.scatter(
                xs,
                [max(c.regret.value, low) for _, c in curve],
                "<b>%{fullData.name}</b>, %{x}<br>regret %{text}",
                mode="lines+markers",
                cliponaxis=False,
                name=style.text(policy),
                line={"color": colour, "width": 2 if out else 1, "dash": "dot" if policy == "clairvoyant" else "solid"},
                opacity=1 if out else 0.55,
                marker={"size": 6 if out else 4, "color": colour},
                text=[f"{with_interval(c.regret, percent)}<br>QoI {with_interval(c.qoi, _fine)}" for _, c in curve],
            )
        )
    ticks = sorted({at for curve in curves.values() for at, _ in curve})
    across = style.axis(**x, showgrid=False, tickvals=ticks, ticktext=[f"{tick:g}" for tick in ticks])
    across["range"] = [math.log10(ticks[0]) - 0.03, math.log10(ticks[-1]) + 0.03]
    layout = style.layout(430, xaxis=across, yaxis=style.log_axis("regret", low, high, style.short_percent))
    layout["annotations"] = _end_labels(context, curves, (low, high), 370)
    longest = max([len(policy) for policy in curves if policy in context.colours], default=0)
    layout["margin"] = {**layout["margin"], "r": max(120, 7 * longest + 12)}
    return {"data": data, "layout": layout}


def _fine(number: float) -> str:
    return f"{number:.2f}"


def _end_labels(context: Context, curves: dict[str, Curve], span: tuple[float, float], pixels: int) -> list[Any]:
    """Names at the right ends of the curves that stand out, moved apart where they would overlap."""
    low, high = (math.log10(end) for end in span)
    ends = {
        p: math.log10(max(curve[-1][1].regret.value, span[0])) for p, curve in curves.items() if p in context.colours
    }
    scale = pixels / (high - low)
    places = style.apart({policy: (y - low) * scale for policy, y in ends.items()}, 15)
    labels = []
    for policy, y in ends.items():
        font = {"size": 12, "color": context.colour(policy)}
        shift = places[policy] - (y - low) * scale
        at = {"x": 1, "xref": "paper", "xanchor": "left", "xshift": 6, "y": y, "yshift": round(shift, 1)}
        labels.append({**style.note(style.text(policy), **at), "font": font})
    return labels


def regret_range(regrets: Sequence[float]) -> tuple[float, float]:
    """Ends of a logarithmic axis: what is below one ten-thousandth (the clairvoyant's 0) is drawn on the lower edge."""
    positive = [regret for regret in regrets if regret > 1e-4]
    if not positive:
        return 1e-4, 1.0
    return min(positive) / 1.4, min(max(positive) * 1.4, 1.0)


def middle_first(sizes: set[int]) -> list[int]:
    """Ascending but for the middle one, which comes first: the one to show at first."""
    ordered = sorted(sizes)
    middle = ordered[len(ordered) // 2 : len(ordered) // 2 + 1]
    return middle + [size for size in ordered if size not in middle]
