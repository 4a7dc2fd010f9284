"""What a policy costs besides information: delay at the sender, age at the server, memory."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from bufgym.benchmark import table
from bufgym.benchmark.report import style
from bufgym.benchmark.report.charts import Chart, Context, middle_first, regret_range, with_interval
from bufgym.benchmark.report.style import Figure
from bufgym.benchmark.score import CellScore

LONG = 8.0
"""Largest over smallest value from which on an axis is logarithmic."""


def delays(context: Context) -> Chart | None:
    """Regret, sojourn time and age of information side by side, for each scenario and capacity."""
    cells: dict[tuple[str, int], dict[str, CellScore]] = {}
    for cell in context.scores.cells:
        if not math.isnan(cell.regret.value):
            cells.setdefault((cell.scenario, cell.capacity), {})[cell.policy] = cell
    if not cells:
        return None
    scenarios = list(dict.fromkeys(scenario for scenario, _ in cells))
    sizes = middle_first({capacity for _, capacity in cells})
    panels: dict[tuple[str, ...], list[Figure]] = {}
    for scenario in scenarios:
        means = table.means([row for row in context.run.rows if row["scenario"] == scenario])
        for capacity in sizes:
            found = cells.get((scenario, capacity), {})
            here = {m["policy"]: m for m in means if m["capacity"] == capacity and m["policy"] in found}
            panels[scenario, str(capacity)] = [_three(context, found, here)] if here else []
    choices = [("Scenario", scenarios), ("Capacity L", [str(size) for size in sizes])]
    alt = "Regret, mean sojourn time and mean age of information of each policy"
    return Chart("delays", alt, choices, panels)


def _three(context: Context, cells: Mapping[str, CellScore], means: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Three columns of dots over the same lanes, least regret on top."""
    names = sorted(means, key=lambda name: cells[name].regret.value, reverse=True)
    low, high = regret_range([cells[name].regret.value for name in names])
    regrets = [max(cells[name].regret.value, low) for name in names]
    words = [with_interval(cells[name].regret, style.percent) for name in names]
    data = [_column(context, names, regrets, "", "regret %{text}", words)]
    place = {"domain": [0, 0.31], "tickangle": 0}
    layout = _lanes(names, xaxis=style.log_axis("regret", low / 1.15, high, style.short_percent, (1, 3), **place))
    for key, title, suffix, start in (
        ("mean_sojourn_s", "mean sojourn time, s", "2", 0.345),
        ("mean_age_s", "mean age of information, s", "3", 0.69),
    ):
        values = [means[name][key] for name in names]
        words = [f"{value:.3g} s" for value in values]
        data.append(_column(context, names, values, suffix, f"{title.removesuffix(', s')} %{{text}}", words))
        layout[f"xaxis{suffix}"] = _seconds_axis(title, values, domain=[start, start + 0.31], tickangle=0)
    return {"data": data, "layout": layout}


def _seconds_axis(title: str, values: Sequence[float], **changes: Any) -> dict[str, Any]:
    positive = [value for value in values if value > 0]  # NaN where nothing was delivered
    if positive and max(positive) / min(positive) >= LONG:
        return style.log_axis(title, min(positive) / 1.3, max(positive) * 1.3, "{:g}".format, **changes)
    return style.axis(title, rangemode="tozero", nticks=6, **changes)


def _column(
    context: Context, names: Sequence[str], values: Sequence[float], suffix: str, title: str, words: Sequence[str]
) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "markers",
        "cliponaxis": False,
        "x": [style.rounded(value) for value in values],
        "y": [style.text(name) for name in names],
        "xaxis": f"x{suffix}",
        "marker": {"color": [context.colour(name) for name in names], "size": 9},
        "text": list(words),
        "hovertemplate": f"<b>%{{y}}</b><br>{title}<extra></extra>",
    }


def _lanes(names: Sequence[str], **changes: Any) -> dict[str, Any]:
    """A layout with one lane a policy, the last on top."""
    lanes = [style.text(name) for name in names]
    y = style.axis(categoryorder="array", categoryarray=lanes, tickvals=lanes, ticks="", showline=False)
    y["range"] = [-0.7, len(names) - 0.3]
    return style.layout(70 + 20 * max(len(names), 3), yaxis=y, **changes)


def memory(context: Context) -> Chart | None:
    """Largest backlog in bytes over all episodes of a scenario, one dot a capacity; None where it was not recorded."""
    peaks: dict[str, dict[str, dict[int, float]]] = {}
    for row in sorted(context.run.rows, key=lambda row: context.run.place(row["scenario"])):
        peak = row.get("peak_backlog_bytes")
        if peak is not None and peak > 0:
            of = peaks.setdefault(row["scenario"], {}).setdefault(row["policy"], {})
            of[row["capacity"]] = max(of.get(row["capacity"], 0.0), float(peak))
    if not peaks:
        return None
    panels: dict[tuple[str, ...], list[Figure]] = {(scenario,): [_peaks(context, of)] for scenario, of in peaks.items()}
    alt = "Largest backlog of each policy in bytes, one dot for each capacity"
    return Chart("memory", alt, [("Scenario", list(peaks))], panels)


def _peaks(context: Context, of: Mapping[str, Mapping[int, float]]) -> Figure:
    """The most hungry policy on top."""
    names = [standing.policy for standing in reversed(context.scores.standings) if standing.policy in of]
    names.sort(key=lambda name: max(of[name].values()))
    data = []
    for name in names:
        sizes, colour = sorted(of[name]), context.colour(name)
        data.append(
            {
                "type": "scatter",
                "mode": "lines+markers",
                "x": [style.rounded(of[name][size] / 1e6) for size in sizes],
                "y": [style.text(name)] * len(sizes),
                "text": [str(size) for size in sizes],
                "line": {"color": colour, "width": 1.5},
                "marker": {"color": colour, "size": 7},
                "hovertemplate": "<b>%{y}</b>, L = %{text}<br>%{x:.3g} MB<extra></extra>",
            }
        )
    values = [peak / 1e6 for sizes in of.values() for peak in sizes.values()]
    x = style.log_axis("largest backlog, MB", min(values) / 1.3, max(values) * 1.3, "{:g}".format)
    return {"data": data, "layout": _lanes(names, xaxis=x)}
