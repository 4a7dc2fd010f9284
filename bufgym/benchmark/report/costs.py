"""Costs of a policy besides information: delay at the sender, age at the server, memory."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from bufgym.benchmark import table
from bufgym.benchmark.report import style
from bufgym.benchmark.report.charts import Chart, Context, middle_first, regret_range, regret_title, with_interval
from bufgym.benchmark.report.style import Figure
from bufgym.benchmark.score import CellScore

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
        means = table.means([row for row in context.run.rows if row["scenario"] == scenario])
        for capacity in sizes:
            scored = cells.get((scenario, capacity), {})
            by_policy = {m["policy"]: m for m in means if m["capacity"] == capacity and m["policy"] in scored}
            panels[scenario, str(capacity)] = [_three(context, scored, by_policy)] if by_policy else []
    choices = [("Scenario", scenarios), ("Capacity L", [str(size) for size in sizes])]
    alt = "Regret, mean sojourn time and mean age of information of each policy"
    return Chart("delays", alt, choices, panels)


def _three(context: Context, cells: Mapping[str, CellScore], means: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Three columns of dots over the same lanes, least regret on top."""
    names = sorted(means, key=lambda name: cells[name].regret.value, reverse=True)
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
    column(regrets, measure, [with_interval(cells[name].regret, table.percent) for name in names])
    place = {"domain": [0, 0.31], "tickangle": 0}
    axes = {"xaxis": style.log_axis(measure, low / 1.15, high, style.short_percent, (1, 3), **place)}
    for key, title, start in (
        ("mean_sojourn_s", "mean sojourn time", 0.345),
        ("mean_age_s", "mean age of information", 0.69),
    ):
        values = [means[name][key] for name in names]
        column(values, title, [f"{value:.3g} s" for value in values])
        place = {"domain": [start, start + 0.31], "tickangle": 0}
        axes[f"xaxis{len(data)}"] = _seconds_axis(f"{title}, s", values, **place)
    return {"data": data, "layout": style.lanes(names, grid=True, **axes)}


def _seconds_axis(title: str, values: Sequence[float], **changes: Any) -> dict[str, Any]:
    positive = [value for value in values if value > 0]  # NaN where nothing was delivered
    if positive and max(positive) / min(positive) >= LONG:
        return style.log_axis(title, min(positive) / 1.3, max(positive) * 1.3, "{:g}".format, **changes)
    return style.axis(title, rangemode="tozero", nticks=6, **changes)


def memory(context: Context) -> Chart | None:
    """Largest backlog in bytes over all episodes of a scenario, one dot a capacity; None where it was not recorded."""
    peaks: dict[str, dict[str, dict[int, float]]] = {}
    for row in sorted(context.run.rows, key=lambda row: context.run.place(row["scenario"])):
        peak = row.get("peak_backlog_bytes")
        if peak is not None and peak > 0:
            by_size = peaks.setdefault(row["scenario"], {}).setdefault(row["policy"], {})
            by_size[row["capacity"]] = max(by_size.get(row["capacity"], 0.0), float(peak))
    if not peaks:
        return None
    panels: dict[tuple[str, ...], list[Figure]] = {
        (scenario,): [_peaks(context, by_policy)] for scenario, by_policy in peaks.items()
    }
    alt = "Largest backlog of each policy in bytes, one dot for each capacity"
    return Chart("memory", alt, [("Scenario", list(peaks))], panels)


def _peaks(context: Context, by_policy: Mapping[str, Mapping[int, float]]) -> Figure:
    """The policy that needs most is on top."""
    names = [standing.policy for standing in reversed(context.summary.overall) if standing.policy in by_policy]
    names.sort(key=lambda name: max(by_policy[name].values()))
    data = []
    for name in names:
        sizes, colour = sorted(by_policy[name]), context.colour(name)
        data.append(
            style.scatter(
                [by_policy[name][size] / 1e6 for size in sizes],
                [style.text(name)] * len(sizes),
                "<b>%{y}</b>, L = %{text}<br>%{x:.3g} MB",
                mode="lines+markers",
                text=[str(size) for size in sizes],
                line={"color": colour, "width": 1.5},
                marker={"color": colour, "size": 7},
            )
        )
    values = [peak / 1e6 for sizes in by_policy.values() for peak in sizes.values()]
    x = style.log_axis("largest backlog, MB", min(values) / 1.3, max(values) * 1.3, "{:g}".format)
    return {"data": data, "layout": style.lanes(names, grid=True, xaxis=x)}
