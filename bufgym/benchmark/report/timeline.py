"""Chart of one episode, message by message: the link's capacity above one lane per policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from bufgym.benchmark.report import style
from bufgym.benchmark.report.charts import Chart, Context
from bufgym.benchmark.report.style import Figure

DROPPED, IN_GAP, KEPT, LEFT = 0, 1, 2, 3
"""Outcomes of a message: dropped, dropped within the longest gap, delivered, still queued at the end."""

COLOURS = ("var(--lane)", "var(--gap)", "var(--kept)", "var(--axis)")


def timeline(context: Context) -> Chart | None:
    """Draw the chart; None if the run left no timeline."""
    episode = context.run.timeline
    if episode is None:
        return None
    alt = "Capacity of the link over time, and for each policy which messages were delivered and which were dropped"
    return Chart("timeline", alt, [], {(): [_figure(episode)]})


def longest_gap(x: Sequence[float], received: Sequence[int]) -> tuple[int, int] | None:
    """Find the consecutive messages received that are furthest apart in x, the first pair on ties.

    Returns (from, to), or None with fewer than two messages.
    """
    pairs = list(pairwise(received))
    return max(pairs, key=lambda pair: x[pair[1]] - x[pair[0]]) if pairs else None


def log(messages: int, lane: Mapping[str, Any], gap: tuple[int, int] | None) -> list[int]:
    """List each message's outcome in order of arrival."""
    outcomes = np.full(messages, LEFT)
    dropped = [entry[0] for entry in lane["dropped"]]
    outcomes[dropped] = DROPPED
    if gap is not None:
        outcomes[[seq for seq in dropped if gap[0] < seq < gap[1]]] = IN_GAP
    outcomes[[entry[0] for entry in lane["received"]]] = KEPT
    return [int(outcome) for outcome in outcomes]


def _figure(episode: Mapping[str, Any]) -> Figure:
    at, x = episode["arrival_s"], episode["x"]
    names = sorted(episode["policies"], key=lambda name: episode["policies"][name]["qoi"])  # the best lane is on top
    rows, hover, notes = [], [], []
    for name in names:
        lane = episode["policies"][name]
        gap = longest_gap(x, [entry[0] for entry in lane["received"]])
        rows.append(log(len(at), lane, gap))
        hover.append(_hover(at, lane))
        cells = [f"{lane['qoi']:.1f}", "–", "–"]
        if gap is not None:
            cells[1:] = f"{x[gap[1]] - x[gap[0]]:.2f}", f"{at[gap[1]] - at[gap[0]]:.1f}"
        notes += _columns(cells, y=style.text(name), yref="y2")
    notes += _columns(["QoI", "gap, x", "gap, s"], y=1, yref="y2 domain", yanchor="bottom")
    lanes = 19 * len(names)
    height = 150 + 46 + lanes + 54
    # Shares of the height for the two parts, link and lanes.
    inside = height - 16 - 44
    layout = style.layout(height, annotations=notes, bargap=0)
    layout["margin"] = {**layout["margin"], "r": 146}
    layout["xaxis"] = style.axis("time, s", anchor="y2", range=[at[0], at[-1]])
    layout["yaxis"] = style.axis("Mbit/s", domain=[(lanes + 46) / inside, 1], rangemode="tozero", nticks=4)
    layout["yaxis2"] = style.axis(domain=[0, lanes / inside], showgrid=False, ticks="", showline=False, type="category")
    layout["yaxis2"]["fixedrange"] = True
    return {"data": [*_link(episode), _lanes(at, names, rows, hover)], "layout": layout}


def _columns(cells: Sequence[str], **place: Any) -> list[dict[str, Any]]:
    """Numbers to the right of the lanes, one below the other."""
    ends = (44, 92, 140)
    right = {"x": 1, "xref": "paper", "xanchor": "right", **place}
    return [style.note(cell, xshift=end, **right) for cell, end in zip(cells, ends, strict=True)]


def _hover(at: Sequence[float], lane: Mapping[str, Any]) -> list[str]:
    words = ["still queued at the end"] * len(at)
    for seq, when in lane["dropped"]:
        words[seq] = f"dropped {when:.2f} s"
    for seq, dequeued, transmitted in lane["received"]:
        words[seq] = f"sent {dequeued:.2f} s, delivered {transmitted:.2f} s"
    return words


def _link(episode: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Capacity as a filled step curve, demand as a dashed line, Mbit/s."""
    times = list(episode["rate"]["t_s"])
    curve = style.scatter(
        times,
        [rate * 8e-6 for rate in episode["rate"]["bytes_per_s"]],
        "link %{y:.2f} Mbit/s at %{x:.1f} s",
        mode="lines",
        line={"shape": "hv", "width": 1, "color": "var(--link)"},
        fill="tozeroy",
        fillcolor="var(--link-fill)",
    )
    demand = episode.get("demand_bytes_per_s")
    if demand is None or not times:
        return [curve]
    dashed = style.scatter(
        [episode["arrival_s"][0], episode["arrival_s"][-1]],
        [demand * 8e-6] * 2,
        "demand %{y:.2f} Mbit/s",
        mode="lines",
        line={"dash": "dash", "width": 1.5, "color": "var(--vermillion)"},
    )
    return [curve, dashed]


def _lanes(at: Sequence[float], names: list[str], rows: list[list[int]], hover: list[list[str]]) -> dict[str, Any]:
    """Draw all lanes as one image, which stays small for thousands of messages."""
    shades = [[edge, colour] for k, colour in enumerate(COLOURS) for edge in (k / 4, (k + 1) / 4)]
    return {
        "type": "heatmap",
        "x": style.rounded(at),
        "y": [style.text(name) for name in names],
        "z": rows,
        "text": hover,
        "zmin": -0.5,
        "zmax": 3.5,
        "colorscale": shades,
        "showscale": False,
        "ygap": 3,
        "xaxis": "x",
        "yaxis": "y2",
        "hovertemplate": "<b>%{y}</b>, arrived at %{x:.2f} s<br>%{text}<extra></extra>",
    }
