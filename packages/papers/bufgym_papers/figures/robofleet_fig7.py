"""Fig. 7 of the Robofleet paper: latency of each topic as a robot drives into a bad zone.

The topics are PoseStamped at 10 Hz, LaserScan at 10 Hz and CompressedImage at 2 Hz. The zone begins at about message
430, which we count on the topics of 10 Hz. The paper does not say how bad the zone was, which topic was no_drop, or
what the priorities were. Here the link falls from one steady rate to another and poses are no_drop. Priorities follow
Robofleet's example client: localization 20, laser scans 2, images 1. We also try lower priorities of images.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from bufgym.benchmark.rows import Row
from bufgym.traces import Trace
from bufgym_papers.figures.figure import COLOURS, finish, legend_below
from bufgym_papers.figures.robofleet_evaluation import (
    BYTES,
    MBIT,
    PROGRAMS,
    QUEUE_SIZE,
    SHORT,
    ClientFigure,
    Sent,
    p95,
    stream,
)
from bufgym_papers.figures.rows import FigureRows

SENDERS = ("robofleet", "rosbridge", "ros-native")
TOPICS = {
    "PoseStamped": (10.0, {"priority": 20.0, "no_drop": True}),
    "LaserScan": (10.0, {"priority": 2.0}),
    "CompressedImage": (2.0, {"priority": 1.0}),
}
"""Kind -> publish rate in Hz and the operator's settings of the topic."""
LOOKS = {
    "PoseStamped": (COLOURS["afr"], "o", 2.5),
    "LaserScan": (COLOURS["drop-oldest"], "s", 2.5),
    "CompressedImage": (COLOURS["random"], "^", 5),
}
"""Kind -> colour, marker and its size."""
COUNTED_HZ = 10.0
SPIKE = 2.0
"""Ratio to a topic's highest latency before the zone; the topic is affected until its last latency beyond that."""


@dataclass(frozen=True)
class Reproduction(ClientFigure):
    """Fig. 7 for these rates in the bad zone."""

    bad_mbit_per_s: Sequence[float] = (4.0, 2.0, 1.0, 0.5)
    good_mbit_per_s: float = 10.0
    """Link rate outside the zone. At 100 rosbridge's backlog vanishes at once, which hides its long recovery."""
    image_priorities: Sequence[float] = (1.0, 0.1, 0.01)
    """Priorities of Robofleet's images: the first in every zone, all of them in the zone shown."""
    bad_from: int = 430  # message of a 10 Hz topic at which the zone begins
    bad_s: float = 30.0  # length of the zone
    after_s: float = 60.0  # time of good link after the zone
    queue_size: int = QUEUE_SIZE  # queue of native ROS, messages per topic
    LIVE = dict(bad_mbit_per_s=(1.0,), image_priorities=(1.0,), bad_from=50, bad_s=15.0, after_s=25.0, runs=1, live=2.0)
    SIZE_INCHES = (8.0, 7.2)

    @property
    def shown(self) -> float:
        """Link rate in the zone shown, the third or the last, Mbit/s."""
        return self.bad_mbit_per_s[:3][-1]

    @property
    def zone_s(self) -> tuple[float, float]:
        """Begin and end of the bad zone."""
        from_s = self.bad_from / COUNTED_HZ
        return from_s, from_s + self.bad_s

    def run(self, bad: float, name: str, image_priority: float, seed: int) -> Sent:
        """Send the messages of one drive through the zone."""
        rates = ((self.zone_s[0], self.good_mbit_per_s), (self.bad_s, bad), (self.after_s, self.good_mbit_per_s))
        link = Trace.steps([(length_s, mbit * MBIT) for length_s, mbit in rates], after="hold")
        changed: dict[str, dict[str, Any]] = {"CompressedImage": {"priority": image_priority}}
        streams = [stream(kind, hz, **(rules | changed.get(kind, {}))) for kind, (hz, rules) in TOPICS.items()]
        return self.send(name, streams, link, self.zone_s[1] + self.after_s, seed)

    def simulate(self) -> FigureRows:
        first, *others = self.image_priorities
        cases = [(bad, name, first) for bad in self.bad_mbit_per_s for name in SENDERS]
        cases += [(self.shown, "robofleet", priority) for priority in others]
        rows = FigureRows()
        for (bad, name, priority), seed in product(cases, range(self.runs)):
            sent = self.once(self.run, bad, name, priority, seed)
            key = {"bad_mbit_per_s": bad, "sender": name, "image_priority": priority, "run": seed}
            rows += [{**key, "topic": kind, **_entry(sent.on(k), self.zone_s)} for k, kind in enumerate(TOPICS)]
        return rows

    def tables(self, rows: FigureRows) -> list[str]:
        looked = {"median_in_zone_ms": "median latency, ms", "p95_in_zone_ms": "95 %, ms", "lost_in_zone": "dropped"}
        lines: list[str] = []
        for bad, priority in rows.distinct("bad_mbit_per_s", "image_priority"):
            shown = rows.where(bad_mbit_per_s=bad, image_priority=priority)
            for column, title in looked.items():
                lines += [f"Zone of {bad:g} Mbit/s, images of priority {priority:g}, messages that came in it: {title}"]
                lines += [*shown.pivot("sender", "topic", column, ",.0f", SHORT), ""]
        return lines[:-1]

    def affected(self, rows: FigureRows, name: str) -> list[float]:
        """List for each zone how long after it the last topic is still affected, s, mean over runs."""
        first = rows.where(sender=name, image_priority=self.image_priorities[0])
        return [
            max(first.mean("affected_after_s", bad_mbit_per_s=bad, topic=kind) for kind in TOPICS)
            for bad in self.bad_mbit_per_s
        ]

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        first = rows.where(image_priority=self.image_priorities[0], bad_mbit_per_s=self.shown)
        lost = sum(row["lost"] for row in rows.where(sender="robofleet", topic="PoseStamped"))
        called = {name: PROGRAMS[name].label.split(",")[0] for name in SENDERS}
        poses = {n: first.mean("median_in_zone_ms", sender=n, topic="PoseStamped") / 1e3 for n in SENDERS}
        affected = {name: self.affected(rows, name) for name in SENDERS}
        pairs = zip(affected["rosbridge"], affected["robofleet"], strict=True)
        every = rows.where(image_priority=self.image_priorities[0])
        spikes = [row["highest_in_zone_ms"] > row["highest_before_ms"] for row in every]
        return {
            "spike": all(spikes),
            "longer": all(bridge > own for bridge, own in pairs),
            "spikes": sum(spikes),
            "played": len(spikes),
            "zones": ", ".join(f"{bad:g}" for bad in self.bad_mbit_per_s),
            "affected": "; ".join(f"{called[n]} {', '.join(f'{s:.1f}' for s in affected[n])} s" for n in SENDERS),
            "no-drop": lost == 0,
            "lost": lost,
            "topics": "; ".join(
                f"{kind} {hz:g} Hz, " + ("no_drop" if rules.get("no_drop") else f"priority {rules['priority']:g}")
                for kind, (hz, rules) in TOPICS.items()
            ),
            "demand": sum(BYTES[kind][1] * hz for kind, (hz, _) in TOPICS.items()) / MBIT,
            "medians": ", ".join(f"{called[name]} {seconds:.2f} s" for name, seconds in poses.items()),
        }

    def draw(self, rows: FigureRows, figure: Any) -> None:
        panels = figure.subplots(len(SENDERS), 1, sharex=True, sharey=True)
        for axes, name in zip(panels, SENDERS, strict=True):
            sent = self.once(self.run, self.shown, name, self.image_priorities[0], 0)
            for k, (kind, (colour, marker, size)) in reversed(list(enumerate(LOOKS.items()))):
                topic, label = sent.on(k), f"{kind}, {TOPICS[kind][0]:g} Hz"
                style = {"color": colour, "markersize": size, "label": label}
                axes.plot(COUNTED_HZ * topic.arrival_s, topic.latency_s, marker, **style)
                dropped = COUNTED_HZ * topic.arrival_s[np.isnan(topic.received_s)]
                # Ticks along the bottom, one line per topic.
                place = {"transform": axes.get_xaxis_transform(), "markersize": 5, "markeredgewidth": 0.6}
                axes.plot(dropped, np.full(len(dropped), 0.03 + 0.045 * k), "|", color=colour, **place)
            axes.axvspan(*(COUNTED_HZ * s for s in self.zone_s), color=COLOURS["other"], alpha=0.2, linewidth=0)
            finish(axes, PROGRAMS[name].label, yscale="log", ylabel="latency, s")
        panels[-1].set_xlabel("message of a 10 Hz topic (an image stands at the one of its time)")
        panels[-1].set_xlim(max(0.0, COUNTED_HZ * (self.zone_s[0] - 10)), COUNTED_HZ * (self.zone_s[1] + self.after_s))
        title = f"Bad zone of {self.shown:g} Mbit/s; ticks along the bottom: dropped"
        figure.suptitle(title, x=0.01, ha="left", fontsize=11)
        legend_below(figure, 4, panels[0])


def _entry(sent: Sent, zone_s: tuple[float, float]) -> Row:
    """Summarize one topic before the zone and in it."""
    zone = sent.between(*zone_s)
    latency_s, received = zone.received.latency_s, sent.received
    before_s = sent.between(0, zone_s[0]).received.latency_s
    late = received.latency_s > SPIKE * before_s.max()
    return {
        "median_before_ms": 1e3 * float(np.median(before_s)),
        "highest_before_ms": 1e3 * float(before_s.max()),
        "median_in_zone_ms": 1e3 * float(np.median(latency_s)) if len(latency_s) else math.nan,
        "p95_in_zone_ms": 1e3 * p95(latency_s),
        "arrived_in_zone": len(zone),
        "lost_in_zone": len(zone) - len(latency_s),
        "highest_in_zone_ms": 1e3 * float(latency_s.max()) if len(latency_s) else math.nan,
        "affected_after_s": max(0.0, float(received.received_s[late].max(initial=0)) - zone_s[1]),
        "lost": len(sent) - len(sent.received),
    }
