"""Fig. 4 of the Robofleet paper: time until latency is nominal again after a dropout.

See packages/papers/bufgym_papers/figures/README.md, "Recovery after a dropout".
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError
from bufgym_papers.figures.figure import COLOURS, UNDECIDED, about, at_least_0, finish, legend_below
from bufgym_papers.figures.robofleet_evaluation import MBIT, PROGRAMS, SHORT, CloudFigure, Sent, stream
from bufgym_papers.figures.rows import FigureRows

SENDERS = ("robofleet", "rosbridge", "ros-native")
RATES_HZ = {"PointCloud2": 5.0, "CompressedImage": 2.0, "LaserScan": 10.0}
KIND_COLOURS = dict(zip(RATES_HZ, (COLOURS["afr"], COLOURS["drop-oldest"], COLOURS["random"]), strict=True))
PAPER_RATIO = 5.0
ABOUT = about(PAPER_RATIO)
FACTOR = 2.0  # Ratio to the nominal latency up to which a latency counts as nominal
BEFORE_S = 10.0
WATCHED = 12.0  # Time watched after the link's return, in dropout lengths; at least ``LEAST_WATCHED_S``
LEAST_WATCHED_S = 30.0


SIMILAR, SIMILAR_TIMES = 0.9, 2.0  # Share of the cells in which Robofleet's recovery must be similar to native ROS's


@dataclass(frozen=True)
class Reproduction(CloudFigure):
    """Fig. 4 for these lengths of the dropout and these links; the picture shows the fastest link."""

    dropouts_s: Sequence[float] = (1, 2, 5, 10, 20, 30)
    links_mbit_per_s: Sequence[float] = (12, 25, 50, 100)
    kinds: Sequence[str] = tuple(RATES_HZ)  # kinds of messages, with one topic in each run
    silence_s: float = 0.0  # silence after the link's return, as TCP may wait for its next retransmission

    RULES = {"silence_s": at_least_0}
    LIVE = {"dropouts_s": (2, 4), "links_mbit_per_s": (6,), "kinds": ("CompressedImage",), "runs": 1, "live": 4.0}
    SIZE_INCHES = (11.0, 4.8)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.kinds or isinstance(self.kinds, str) or not set(self.kinds) <= set(RATES_HZ):
            raise BufgymError(f"kinds = {self.kinds!r}: must be some of {', '.join(RATES_HZ)}")

    def run(self, kind: str, mbit: float, dropout_s: float, name: str, seed: int) -> tuple[float, Sent]:
        """Play one dropout; return when the link goes away, and the messages' outcome."""
        away_s = BEFORE_S + float(np.random.default_rng(seed).random()) / RATES_HZ[kind]
        outage_s = dropout_s + self.silence_s
        watched_s = max(LEAST_WATCHED_S, WATCHED * outage_s)
        link = Trace.steps([(away_s, mbit * MBIT), (outage_s, 0), (watched_s, mbit * MBIT)], after="hold")
        streams = (stream(kind, RATES_HZ[kind], points=self.points),)
        return away_s, self.send(name, streams, link, away_s + outage_s + watched_s, seed)

    def simulate(self) -> FigureRows:
        rows = FigureRows()
        for kind, mbit, dropout_s, seed, name in product(
            self.kinds, self.links_mbit_per_s, self.dropouts_s, range(self.runs), SENDERS
        ):
            away_s, sent = self.once(self.run, kind, mbit, dropout_s, name, seed)
            key = {"message": kind, "link_mbit_per_s": mbit, "dropout_s": dropout_s, "run": seed, "sender": name}
            rows.append(key | {"recovery_s": recovery_s(sent, away_s, away_s + dropout_s, FACTOR)})
        return rows

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        cells = by_cell(rows)
        ratios = {key: ratio(cell) for key, cell in cells.items()}
        accepted = [key for key, r in ratios.items() if ABOUT[0] <= r <= ABOUT[1]]
        less = sum(r < ABOUT[0] for r in ratios.values())
        lengths = {
            group: ", ".join(f"{d:g} s" for *g, d in accepted if (*g,) == group)
            for group in dict.fromkeys((kind, mbit) for kind, mbit, _ in accepted)
        }
        trios = [dict(zip(SENDERS, cell, strict=True)) for cell in cells.values()]
        known = [trio for trio in trios if 0 < trio["robofleet"] < math.inf and 0 < trio["ros-native"] < math.inf]
        near = [trio["robofleet"] <= SIMILAR_TIMES * trio["ros-native"] for trio in known]
        return {
            "native": sum(near) >= SIMILAR * len(near) if near else None,
            "near_cells": sum(near),
            "known_cells": len(near),
            "sooner": UNDECIDED,  # the length of the paper's dropout is open
            "cells": len(cells),
            "sooner_cells": sum(r > 1 for r in ratios.values()),
            "about_cells": len(accepted),
            "less": less,
            "more": len(cells) - less - len(accepted),
            "about": "; ".join(f"{kind} at {mbit:g} Mbit/s {shown}" for (kind, mbit), shown in lengths.items()),
        }

    def tables(self, rows: FigureRows) -> list[str]:
        lines = ["Recovery of rosbridge to Robofleet's, by the length of the dropout in s:"]
        cells = FigureRows(
            {"topic": f"{kind}, {mbit:g} Mbit/s", "dropout_s": dropout_s, "ratio": ratio(cell)}
            for (kind, mbit, dropout_s), cell in by_cell(rows).items()
        )
        lines += [*cells.pivot("topic", "dropout_s", "ratio", ".1f"), "", "Recovery, s, mean over links:"]
        for kind in self.kinds:
            lines += [kind, *rows.where(message=kind).pivot("sender", "dropout_s", "recovery_s", ".3f", SHORT)]
        return lines

    def draw(self, rows: FigureRows, figure: Any) -> None:
        left, right = figure.subplots(1, 2)
        shown_s = min(self.dropouts_s, key=lambda s: abs(s - 10))
        kind, mbit = self.kinds[0], max(self.links_mbit_per_s)
        for name in reversed(SENDERS):
            away_s, sent = self.once(self.run, kind, mbit, shown_s, name, 0)
            received, style = sent.received, PROGRAMS[name].style | {"markersize": 3, "linewidth": 0}
            at_s = received.received_s - away_s - shown_s
            near = np.abs(at_s) < shown_s + 3
            left.plot(at_s[near], received.latency_s[near], label=PROGRAMS[name].label, **style)
        left.axvspan(-shown_s, 0, color=COLOURS["other"], alpha=0.2, linewidth=0, label="no link")
        title = f"{kind}, {mbit:g} Mbit/s, dropout of {shown_s:g} s"
        finish(left, title, yscale="log", xlabel="receipt, s after the link's return", ylabel="latency, s")
        left.legend(loc="upper left", frameon=False)
        cells = by_cell(rows)
        for kind, (k, mbit) in product(self.kinds, enumerate(self.links_mbit_per_s)):
            ratios = [ratio(cells[kind, mbit, dropout]) for dropout in self.dropouts_s]
            style = {"color": KIND_COLOURS[kind], "marker": "osD^vPX*"[k % 8], "markersize": 4.5, "linewidth": 1.2}
            right.plot(self.dropouts_s, ratios, label=f"{kind}, {mbit:g} Mbit/s", **style)
        right.axhspan(*ABOUT, color=COLOURS["other"], alpha=0.35, linewidth=0, label="paper, about 5")
        title = "Rosbridge's recovery time to Robofleet's"
        finish(right, title, xscale="log", yscale="log", xlabel="length of the dropout, s")
        legend_below(figure, 4, right)


def recovery_s(sent: Sent, away_s: float, back_s: float, factor: float) -> float:
    """Time from the link's return at ``back_s`` until latency stays within ``factor`` times nominal, or inf.

    The nominal latency is the median over messages received before ``away_s``, when the link went away.
    """
    received = sent.received
    latency_s = received.latency_s
    before = received.received_s <= away_s
    if not before.any():
        raise BufgymError("nothing was received before the dropout: no latency to call nominal")
    late = np.flatnonzero(latency_s > factor * np.median(latency_s[before]))
    late = late[received.received_s[late] > away_s]
    if len(late) == 0:
        return 0.0
    if late[-1] + 1 == len(received):
        return math.inf
    return max(0.0, float(received.received_s[late[-1] + 1]) - back_s)


Cells = dict[tuple[str, float, float], tuple[float, ...]]
"""(kind, Mbit/s, dropout in s) -> recovery of each of ``SENDERS``, s."""


def ratio(cell: Sequence[float]) -> float:
    """Divide rosbridge's recovery time by Robofleet's."""
    return cell[1] / cell[0] if cell[0] > 0 and math.isfinite(cell[0]) else math.nan


def by_cell(rows: FigureRows) -> Cells:
    """Average the recovery of each of ``SENDERS`` for each message kind, link and dropout."""
    return {
        (kind, mbit, dropout): tuple(
            rows.mean("recovery_s", message=kind, link_mbit_per_s=mbit, dropout_s=dropout, sender=name)
            for name in SENDERS
        )
        for kind, mbit, dropout in rows.distinct("message", "link_mbit_per_s", "dropout_s")
    }
