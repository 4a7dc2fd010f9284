"""The charts, each a ``Chart`` of plain dictionaries that plotly draws; every statistic in them is ``score``'s."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bufgym.benchmark.folder import Run
from bufgym.benchmark.report import style
from bufgym.benchmark.report.style import Figure
from bufgym.benchmark.score import CellScore, Interval, Scores, Standing


@dataclass(frozen=True)
class Chart:
    """One place on the page."""

    id: str
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
    scores: Scores
    colours: dict[str, str]

    @classmethod
    def of(cls, run: Run, scores: Scores) -> Context:
        return cls(run, scores, style.colours([s.policy for s in scores.standings if s.ranked]))

    def colour(self, policy: str) -> str:
        return self.colours.get(policy, style.MUTED)

    def order(self, policies: Sequence[str]) -> list[str]:
        """Muted ones first, so that the others are drawn on top of them."""
        return sorted(policies, key=lambda name: name in self.colours)


# --- ranking ---------------------------------------------------------------------------------------------------------


def ranking(context: Context) -> Chart | None:
    """Score and probability of improvement, a dot and an interval for each policy; None where no policy has a score."""
    scores = context.scores
    if all(math.isnan(standing.score.value) for standing in scores.standings):
        return None
    one = _dots(context, "score", lambda s: s.score, lambda s: s.iqm, ("0 = Drop Oldest, 1 = clairvoyant", -1.0, 1.05))
    one["layout"]["shapes"] = [style.line("x", 0), style.line("x", 1)]
    two = _dots(
        context, "probability of improvement", lambda s: s.improvement, None, (f"over {scores.reference}", -1.0, 1.0)
    )
    two["layout"]["shapes"] = [style.line("x", 0.5)]
    panels = [one, two] if any(not math.isnan(s.improvement.value) for s in scores.standings) else [one]
    alt = "Score of each policy, and its probability of improvement, with intervals; the numbers are in the table above"
    return Chart("ranking", alt, [], {(): panels})


def _dots(
    context: Context,
    title: str,
    main: Callable[[Standing], Interval],
    second: Callable[[Standing], Interval] | None,
    axis: tuple[str, float, float],
) -> Figure:
    about, floor, high = axis
    ceiling = 2 * high  # a queue without a bound may do better than a clairvoyant with one
    shown = [s for s in context.scores.standings if not math.isnan(main(s).value)]
    low = min([main(s).low for s in shown if main(s).high >= floor] + [0.0]) - 0.04
    high = max([main(s).high + 0.05 for s in shown if main(s).low <= ceiling] + [high])
    data: list[dict[str, Any]] = []
    notes = []
    for s in shown:
        value, colour = main(s), context.colour(s.policy)
        if value.high < floor:  # far off: the number at the edge instead
            words = f"◂ {style.score(value.value)}"
            notes.append(style.note(words, x=low, y=style.text(s.policy), xanchor="left", xshift=2))
            continue
        if value.low > ceiling:
            words = f"{style.score(value.value)} ▸"
            notes.append(style.note(words, x=high, y=style.text(s.policy), xanchor="right", xshift=-2))
            continue
        arms = {"array": [value.high - value.value], "arrayminus": [value.value - value.low]}
        words = f"<b>%{{y}}</b><br>{title} {with_interval(value, style.score)}<extra></extra>"
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "x": [style.rounded(value.value)],
                "y": [style.text(s.policy)],
                "marker": {"color": colour, "size": 9, "symbol": "circle" if s.ranked else "circle-open"},
                "error_x": {"type": "data", "symmetric": False, **arms, "color": colour, "thickness": 2, "width": 0},
                "hovertemplate": words,
            }
        )
        if second is not None and not math.isnan(second(s).value):
            words = f"<b>%{{y}}</b><br>IQM {with_interval(second(s), style.score)}<extra></extra>"
            marker = {"color": colour, "size": 8, "symbol": "line-ns-open", "line": {"width": 1.5}}
            at = {"x": [style.rounded(second(s).value)], "y": [style.text(s.policy)]}
            data.append({"type": "scatter", "mode": "markers", **at, "marker": marker, "hovertemplate": words})
    names = [style.text(s.policy) for s in reversed(shown)]
    x = style.axis(f"{title} ({about})", range=[low, high], nticks=7)
    y = style.axis(categoryorder="array", categoryarray=names, range=[-0.7, len(names) - 0.3], tickmode="array")
    y |= {"tickvals": names, "showgrid": False, "ticks": "", "showline": False}
    height = 70 + 20 * max(len(shown), 3)
    return {"data": data, "layout": style.layout(height, xaxis=x, yaxis=y, annotations=notes)}


def with_interval(value: Interval, write: Callable[[float], str]) -> str:
    return f"{write(value.value)} [{write(value.low)}, {write(value.high)}]"


# --- regret against something -----------------------------------------------------------------------------------------


def capacities(context: Context) -> Chart | None:
    """Regret against L, a scenario at a time; None where there is but one capacity."""
    cells = context.scores.cells
    if len({cell.capacity for cell in cells}) < 2:
        return None
    panels: dict[tuple[str, ...], list[Figure]] = {}
    for scenario in dict.fromkeys(cell.scenario for cell in cells):
        curves = _curves([c for c in cells if c.scenario == scenario], lambda c: float(c.capacity))
        x = {"title": "capacity L, messages", "type": "log"}
        panels[(scenario,)] = [_regret_curves(context, curves, x)] if curves else []
    panels = {key: figures for key, figures in panels.items() if figures}
    if not panels:
        return None
    options = [scenario for (scenario,) in panels]
    alt = "Regret of each policy against the capacity L, with intervals"
    return Chart("capacities", alt, [("Scenario", options)], panels)


def outages(context: Context) -> Chart | None:
    """Regret against the length of the one outage, for each V and capacity; None with fewer than two lengths."""
    about = context.run.manifest["scenarios"]
    lengths = {name: float(s["outage_s"]) for name, s in about.items() if s.get("outage_s") is not None}
    cells = [cell for cell in context.scores.cells if cell.scenario in lengths]
    panels: dict[tuple[str, ...], list[Figure]] = {}
    values = list(dict.fromkeys(str(about[cell.scenario].get("value", "")) for cell in cells))
    sizes = middle_first({cell.capacity for cell in cells})
    for value in values:
        for capacity in sizes:
            chosen = [c for c in cells if (str(about[c.scenario].get("value", "")), c.capacity) == (value, capacity)]
            curves = _curves(chosen, lambda c: lengths[c.scenario])
            x = {"title": "length of the outage, s", "type": "log"}
            panels[(value, str(capacity))] = [_regret_curves(context, curves, x)] if curves else []
    if len({lengths[cell.scenario] for cell in cells}) < 2 or not any(panels.values()):
        return None
    choices = [("Value of a step", values), ("Capacity L", [str(size) for size in sizes])]
    return Chart("outages", "Regret of each policy against the length of the outage, with intervals", choices, panels)


Curve = list[tuple[float, CellScore]]


def _curves(cells: Sequence[CellScore], at: Callable[[CellScore], float]) -> dict[str, Curve]:
    """By policy: where and what, from left to right; cells without a regret are left out."""
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
            ys = [style.rounded(max(y, low)) for y in band]
            area = {"fill": "toself", "fillcolor": colour, "opacity": 0.16, "line": {"width": 0}, "hoverinfo": "skip"}
            data.append({"type": "scatter", "mode": "lines", "x": xs + xs[::-1], "y": ys, **area})
        lines = {"color": colour, "width": 2 if out else 1, "dash": "dot" if policy == "clairvoyant" else "solid"}
        words = [with_interval(c.regret, style.percent) + f"<br>QoI {with_interval(c.qoi, _fine)}" for _, c in curve]
        data.append(
            {
                "type": "scatter",
                "mode": "lines+markers",
                "cliponaxis": False,
                "name": style.text(policy),
                "x": xs,
                "y": [style.rounded(max(c.regret.value, low)) for _, c in curve],
                "line": lines,
                "opacity": 1 if out else 0.55,
                "marker": {"size": 6 if out else 4, "color": colour},
                "text": words,
                "hovertemplate": "<b>%{fullData.name}</b>, %{x}<br>regret %{text}<extra></extra>",
            }
        )
    ticks = sorted({at for curve in curves.values() for at, _ in curve})
    across = style.axis(**x, showgrid=False, tickvals=ticks, ticktext=[f"{tick:g}" for tick in ticks])
    across["range"] = [math.log10(ticks[0]) - 0.03, math.log10(ticks[-1]) + 0.03]
    layout = style.layout(430, xaxis=across, yaxis=style.log_axis("regret", low, high, style.short_percent))
    layout["annotations"] = _end_labels(context, curves, (low, high), 370)
    layout["margin"] = {**layout["margin"], "r": 120}
    return {"data": data, "layout": layout}


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


def _fine(number: float) -> str:
    return f"{number:.2f}"


def middle_first(sizes: set[int]) -> list[int]:
    """Ascending but for the middle one, which comes first: the one to show at first."""
    ordered = sorted(sizes)
    middle = ordered[len(ordered) // 2 : len(ordered) // 2 + 1]
    return middle + [size for size in ordered if size not in middle]
