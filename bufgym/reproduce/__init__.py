"""The AFR and Robofleet papers' figures, tables and theorems again: our number beside the paper's.

``run("afr-fig5", Path("out"))`` returns a text to print and saves the numbers (CSV) and the figure (PNG) under ``out``.
Each figure is one file, imported only when it is asked for. The numbers need nothing beyond bufgym (those of
robofleet-table1 its extra ``robofleet``); the figure needs matplotlib, which comes with ``bufgym[plot]``.
"""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path
from typing import Any

from bufgym.errors import BufgymError
from bufgym.reproduce.report import Report

FIGURES: dict[str, str] = {
    "afr-fig4": "AFR paper, Fig. 4: which messages AFR keeps as an interruption grows, L = 8",
    "afr-fig5": "AFR paper, Fig. 5: information gained against the length of the interruption, L = 8",
    "afr-fig6": "AFR paper, Fig. 6: bandwidth of the 4G log car_0002 against the camera's demand",
    "afr-fig7-qoi": "AFR paper, Fig. 7, in information: QoI lost against the queue size, over car_0002",
    "afr-fig8-gap": "AFR paper, Fig. 8, by motion gaps: runs in which tracking would fail, over car_0002",
    "afr-theorems": "AFR paper, Theorems 1-3: AFR against oracle-ideal for every L, T and V",
    "afr-fig9": "AFR paper, Fig. 9: time of one decision of each built-in policy, on this machine",
    "robofleet-table1": (
        "Robofleet paper, Table I: bytes of a message as ROS binary, flatbuffer and JSON, really encoded"
    ),
    "robofleet-fig3": "Robofleet paper, Fig. 3: latency and throughput against the publish rate, n_T = 1 and no_drop",
    "robofleet-fig4": "Robofleet paper, Fig. 4: recovery after a dropout, beside rosbridge and native ROS",
    "robofleet-fig5": "Robofleet paper, Fig. 5: latency and throughput while capacity falls from 100 to 4 Mbit/s",
    "robofleet-fig6": "Robofleet paper, Fig. 6: latency against the number of consumers, beside native ROS",
    "robofleet-fig7": "Robofleet paper, Fig. 7: latency of each topic in a bad zone, beside rosbridge and native ROS",
}
"""Name -> what it shows, in one line."""

NEEDS_DATA: dict[str, str] = {
    "afr-fig6": "belgium_4g/csv/report_car_0002.csv",
    "afr-fig7-qoi": "belgium_4g/csv/report_car_0002.csv and tum_rgbd/*.groundtruth.txt.gz",
    "afr-fig8-gap": "belgium_4g/csv/report_car_0002.csv and tum_rgbd/*.groundtruth.txt.gz",
}
"""Figures over recordings -> what the folder given as their option ``data`` must hold."""


def run(name: str, out: Path | None = None, **options: Any) -> str:
    """Reproduce one figure; the text compares our numbers with the paper's.

    Args:
        name: a key of ``FIGURES``.
        out: folder for ``<name>.csv`` and ``<name>.png``, made where absent; None saves nothing.
        options: what that figure's ``report`` takes, such as ``runs`` for afr-fig5.
    """
    if name not in FIGURES:
        raise BufgymError(f"unknown figure {name!r}; known: {', '.join(FIGURES)}")
    make = importlib.import_module(f"bufgym.reproduce.{name.replace('-', '_')}").report
    known = inspect.signature(make).parameters
    for option in options:
        if option not in known:
            raise BufgymError(f"{name}: no option {option!r}; it has: {', '.join(known)}")
    report: Report = make(**options)
    if out is None:
        return report.text
    lines = [report.text, f"numbers: {report.save_numbers(out / f'{name}.csv')}"]
    try:
        lines.append(f"figure: {report.save_figure(out / f'{name}.png')}")
    except BufgymError as error:  # the numbers stand without it
        lines.append(f"no figure: {error}")
    return "\n".join(lines)
