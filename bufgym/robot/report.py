"""The page of ``bufgym live validate``: the same episodes on real sockets and in the simulator, in pictures."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from bufgym import __version__
from bufgym.benchmark.report import style
from bufgym.benchmark.report.charts import Chart
from bufgym.benchmark.report.page import rendered
from bufgym.benchmark.report.style import Figure
from bufgym.ground.errors import BufgymError
from bufgym.ground.files import read_utf8, replaced
from bufgym.robot.margins import margins
from bufgym.robot.runs import COLUMNS, Run, agreement, by_policy, cells

MAX_BYTES = 2**28
_POINTS = 200
"""Points of a curve of delivery times."""


def write(runs_file: Path) -> Path:
    """Write ``report.html`` beside the ``runs.json`` of a validation; return its path.

    Raises:
        BufgymError: no such file, one that holds no runs, or where plotly or Jinja is not installed.
    """
    try:
        kept = json.loads(read_utf8(runs_file, MAX_BYTES))
        runs = [Run(**one) for one in kept["runs"]]
        about, command = str(kept["about"]), str(kept["command"])
    except (ValueError, KeyError, TypeError) as error:
        if isinstance(error, BufgymError):
            raise
        raise BufgymError(f"{runs_file}: must hold the runs of bufgym live validate") from None
    target = runs_file.with_name("report.html")
    with replaced(target) as temporary:
        temporary.write_text(html(runs, about, command), encoding="utf-8")
    return target


def html(runs: Sequence[Run], about: str, command: str) -> str:
    """The whole page."""
    ranked = list(by_policy(runs))
    colours = style.colours(ranked, "drop-oldest")
    return rendered(
        "live",
        [apart(runs, colours), regrets(runs, colours), delivery(runs, colours)],
        about=about,
        command=command,
        agreement=agreement(runs),
        margins=list(map(str, margins(runs))),
        columns=[title for title, _, _ in COLUMNS],
        rows=cells(runs),
        colour=lambda policy: colours.get(policy, style.MUTED),
        version=__version__,
        links=sorted({one.link for one in runs}),
        transports=sorted({one.transport for one in runs}),
    )


def apart(runs: Sequence[Run], colours: dict[str, str]) -> Chart:
    """A dot for each run: QoI and messages delivered, live less simulated."""
    panels = [
        _dots(runs, colours, "QoI, live less simulated, %", [100 * one.qoi_difference for one in runs], 0.5),
        _dots(runs, colours, "delivered, live less simulated", [one.delivered_difference for one in runs], 1),
    ]
    return Chart("apart", "QoI and messages delivered of each run, live less simulated", [], {(): panels})


def _dots(runs: Sequence[Run], colours: dict[str, str], title: str, numbers: Sequence[float], goal: float) -> Figure:
    """Draw a lane for each policy; the band shows the tolerated difference."""
    most = 1.15 * max(2 * goal, *(abs(number) for number in numbers))
    data = []
    for policy in reversed(by_policy(runs)):
        chosen = [(one, number) for one, number in zip(runs, numbers, strict=True) if one.policy == policy]
        data.append(
            style.scatter(
                [number for _, number in chosen],
                [style.text(policy)] * len(chosen),
                "<b>%{y}</b>: %{x:.3g}<br>%{text}",
                text=[style.text(f"{one.link}, {one.transport}, seed {one.seed}") for one, _ in chosen],
                marker={"color": colours.get(policy, style.MUTED), "size": 9, "opacity": 0.75},
                cliponaxis=False,
            )
        )
    layout = style.lanes(list(reversed(by_policy(runs))), grid=True, xaxis=style.axis(title, range=[-most, most]))
    band = {"type": "rect", "layer": "below", "x0": -goal, "x1": goal, "y0": 0, "y1": 1, "yref": "y domain"}
    layout["shapes"] = [{**band, "fillcolor": "var(--hatch)", "line": {"width": 0}}, style.line("x", 0)]
    return {"data": data, "layout": layout}


def regrets(runs: Sequence[Run], colours: dict[str, str]) -> Chart:
    """Regret by policy, one link at a time: a dot live, a ring simulated."""
    panels, choices = _chosen(runs, lambda chosen: _regret(chosen, colours))
    return Chart("regret", "Regret of each policy, live and simulated", choices, panels)


def _regret(runs: Sequence[Run], colours: dict[str, str]) -> Figure:
    lanes = list(reversed(by_policy(runs)))
    data = []
    for policy in lanes:
        chosen, colour, lane = by_policy(runs)[policy], colours.get(policy, style.MUTED), style.text(policy)
        for one in chosen:
            ends = [100 * one.simulated_regret, 100 * one.live_regret]
            data.append(style.scatter(ends, [lane] * 2, mode="lines", line={"color": colour, "width": 2}))
        for side, symbol, size in (("simulated", "circle-open", 13), ("live", "circle", 8)):
            numbers = [100 * getattr(one, f"{side}_regret") for one in chosen]
            marker: dict[str, Any] = {
                "color": colour,
                "size": size,
                "symbol": symbol,
                "line": {"width": 2 if side == "simulated" else 0},
            }
            hover = f"<b>%{{y}}</b>, {side}<br>regret %{{x:.3g}} %"
            data.append(style.scatter(numbers, [lane] * len(chosen), hover, marker=marker, cliponaxis=False))
    return {"data": data, "layout": style.lanes(lanes, grid=True, xaxis=style.axis("regret, %", rangemode="tozero"))}


def delivery(runs: Sequence[Run], colours: dict[str, str]) -> Chart:
    """Draw the share of messages delivered within a time: lines live, dots simulated."""
    panels, choices = _chosen(runs, lambda chosen: _shares(chosen, colours))
    return Chart("delivery", "Share of the messages delivered within a time, live and simulated", choices, panels)


def _shares(runs: Sequence[Run], colours: dict[str, str]) -> Figure:
    data, shares = [], np.linspace(0, 1, _POINTS)
    for policy, chosen in by_policy(runs).items():
        for side, dash in (("live", "solid"), ("simulated", "dot")):
            times = [time_s for one in chosen for time_s in getattr(one, f"{side}_s")]
            if times:
                look = {"color": colours.get(policy, style.MUTED), "dash": dash, "width": 2}
                name = style.text(f"{policy}, {side}")
                hover = "<b>%{fullData.name}</b><br>%{y:.0f} % within %{x:.3g} s"
                xs = np.quantile(times, shares).tolist()
                data.append(style.scatter(xs, (100 * shares).tolist(), hover, "lines", name=name, line=look))
    across = style.axis("from arrival at the queue to receipt, s", rangemode="tozero")
    legend = {"orientation": "h", "y": -0.25, "x": 0}
    layout = style.layout(400, xaxis=across, yaxis=style.axis("messages, %"), showlegend=True, legend=legend)
    return {"data": data, "layout": layout}


def _chosen(runs: Sequence[Run], draw: Any) -> tuple[dict[tuple[str, ...], list[Figure]], list[tuple[str, list[str]]]]:
    """Draw a figure for each link and transport, and list the choices."""
    links = list(dict.fromkeys(one.link for one in runs))
    transports = list(dict.fromkeys(one.transport for one in runs))
    panels: dict[tuple[str, ...], list[Figure]] = {}
    for link, transport in product(links, transports):
        chosen = [one for one in runs if (one.link, one.transport) == (link, transport)]
        panels[link, transport] = [draw(chosen)] if chosen else []
    return panels, [("Link", links), ("Transport", transports)]
