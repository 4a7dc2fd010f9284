"""Fig. 6 of the Robofleet paper: latency against the number of consumers of 5 Hz point clouds over 12 Mbit/s.

Native ROS sends one copy to each consumer over the uplink. Robofleet sends one copy to its server, which copies it.
Only the uplink is simulated; the server's own links are left out. The paper gives neither the size of a cloud nor the
publisher's queue, so we show several of each; the link can carry the smallest clouds eight times. Only messages
received while clouds are published count, not messages that full queues deliver afterwards.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from bufgym.traces import steady
from bufgym_papers.figures.figure import COLOURS, either, finish, legend_below, several, whole
from bufgym_papers.figures.robofleet_evaluation import MBIT, PROGRAMS, ClientFigure, cloud_bytes, p95, stream
from bufgym_papers.figures.rows import FigureRows, average, listed

COMPARABLE = 2.0  # Latencies within this factor of each other count as comparable
NAMES = ("rosbridge", "ros-native", "robofleet")
STRAIGHT = 0.98  # Least correlation of native ROS's mean latency with the number of consumers that counts as linear


@dataclass(frozen=True)
class Reproduction(ClientFigure):
    """Fig. 6 for clouds of ``points`` points and 1 to ``max_consumers`` consumers."""

    points: Sequence[int] = (1_500, 4_000, 10_000)  # numbers of points of a cloud, 16 bytes each; one panel per number
    max_consumers: int = 8
    rate_hz: float = 5.0
    mbit_per_s: float = 12.0
    queue_sizes: Sequence[int] = (1, 10)  # queues of native ROS, in messages to each consumer; one line per size
    duration_s: float = 60.0  # publishing time

    LIVE = {"points": (4_000,), "max_consumers": 4, "queue_sizes": (10,), "duration_s": 6.0, "runs": 1, "live": 1.0}
    RULES = {"points": several(whole(1, 10**7)), "max_consumers": whole(2, 100)}

    def simulate(self) -> FigureRows:
        link = steady(self.mbit_per_s * MBIT)
        senders = [("robofleet", 1), ("rosbridge", 1), *(("ros-native", queue) for queue in self.queue_sizes)]
        rows = FigureRows()
        every_n = range(1, self.max_consumers + 1)
        for points, n, (name, queue), seed in product(self.points, every_n, senders, range(self.runs)):
            topic = stream("PointCloud2", self.rate_hz, points=points)
            settings = {"queue_size": queue, "consumers": n, "watched_s": self.duration_s}
            sent = self.send(name, (topic,), link, self.duration_s, seed, **settings)
            in_time = sent.received_s <= self.duration_s
            latency_s = sent.latency_s[in_time]
            reached = np.bincount(sent.consumer, in_time) / np.bincount(sent.consumer)  # share of each consumer
            label = f"native ROS, queue of {queue}" if name == "ros-native" else PROGRAMS[name].label.split(",")[0]
            key = {"points": points, "consumers": n, "sender": name, "queue_size": queue, "run": seed, "line": label}
            latency = {"mean_latency_s": average(latency_s), "p95_latency_s": p95(latency_s)}
            shares = {"received_share": float(in_time.mean()), "least_received_share": float(reached.min())}
            rows.append({**key, **latency, **shares})
        return rows

    def fits(self, points: int) -> float:
        """Number of copies of such a cloud, as ROS binary, that the link carries."""
        return self.mbit_per_s * MBIT / (self.rate_hz * cloud_bytes(points)[0])

    def tables(self, rows: FigureRows) -> list[str]:
        """For each size of cloud what the link carries, then mean latency (s) and received shares by consumers."""
        lines: list[str] = []
        for points in self.points:
            ros, flatbuffer, _ = cloud_bytes(points)
            shown, carried = rows.where(points=points), min(self.max_consumers, int(self.fits(points)))
            lines += [
                f"{points:,} points, {ros:,} bytes as ROS binary, {flatbuffer:,} as flatbuffer: the link carries "
                f"{carried} of {self.max_consumers} copies.",
                "Mean latency, s, by consumers; then the share received, on average and by the worst off:",
                *shown.pivot("line", "consumers", "mean_latency_s", ".3f"),
                *shown.pivot("line", "consumers", "received_share", ".0%"),
                *shown.pivot("line", "consumers", "least_received_share", ".0%"),
                "",
            ]
        return lines[:-1]

    def latencies_s(self, rows: FigureRows, points: int, line: str) -> list[float]:
        """Mean latency of a line for 1, 2, ... consumers."""
        shown = rows.where(points=points, line=line)
        return [shown.mean("mean_latency_s", consumers=n) for n in range(1, self.max_consumers + 1)]

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        growth, slopes = dict[int, float](), list[str]()
        linear = list[bool]()
        for points in self.points:
            first, *_, last = self.latencies_s(rows, points, "Robofleet")
            growth[points] = last / first
            for line in rows.where(sender="ros-native").distinct("line"):
                latency_s, consumers = self.latencies_s(rows, points, line), range(1, self.max_consumers + 1)
                straight = float(np.corrcoef(consumers, latency_s)[0, 1])
                slope = float(np.polyfit(consumers, latency_s, 1)[0])
                linear.append(straight >= STRAIGHT and slope > 0)
                text = f"{slope:.3f} s a consumer, r = {straight:.3f}"
                slopes.append(f"{points:,} points, {line} {'yes' if linear[-1] else 'NO'} ({text})")
        one = rows.where(consumers=1)
        trios = {p: [one.mean("mean_latency_s", points=p, sender=n) for n in NAMES] for p in self.points}
        return {
            "rosbridge": all(bridge > native for bridge, native, _ in trios.values()),
            "bridge": _spelled(trios, ".3f", " s"),
            "growth": listed([f"{ratio:.2f} times at {points:,} points" for points, ratio in growth.items()]),
            "linear": either(linear),
            **self.many(rows),
            "slopes": "; ".join(slopes),
        }

    def many(self, rows: FigureRows) -> dict[str, Any]:
        """Latency and share received of each program with the most consumers."""
        last = rows.where(consumers=self.max_consumers)
        by = {
            column: {p: [last.mean(column, points=p, sender=n) for n in NAMES] for p in self.points}
            for column in ("mean_latency_s", "received_share")
        }
        slower = {p: (bridge / native, own / native) for p, (bridge, native, own) in by["mean_latency_s"].items()}
        return {
            "comparable": either([1 / COMPARABLE <= bridge <= COMPARABLE for bridge, _ in slower.values()]),
            "outperforms": all(own < min(1.0, bridge) / COMPARABLE for bridge, own in slower.values()),
            "throughput": all(own >= native / COMPARABLE for _, native, own in by["received_share"].values()),
            "many_s": _spelled(by["mean_latency_s"], ".3f"),
            "many_share": _spelled(by["received_share"], ".0%"),
        }

    def size_inches(self, rows: FigureRows) -> tuple[float, float]:
        return max(5.6, 4.4 * len(self.points) + 0.4), 4.2  # at least the legend's width

    def draw(self, rows: FigureRows, figure: Any) -> None:
        panels = figure.subplots(1, len(self.points), squeeze=False)[0]
        consumers = range(1, self.max_consumers + 1)
        for axes, points in zip(panels, self.points, strict=True):
            for k, (name, label) in enumerate(rows.distinct("sender", "line")):
                style = PROGRAMS[name].style | {"zorder": 3 - 0.1 * k}
                if k > 2:  # markers of further queues are open and larger, so that equal lines stay visible
                    style |= {"linestyle": "--", "markersize": 5.5 + 2 * k, "markerfacecolor": "none"}
                axes.plot(consumers, self.latencies_s(rows, points, label), label=label, **style)
            if (fits := self.fits(points)) < self.max_consumers:
                axes.axvspan(max(fits, 0.8), self.max_consumers + 0.2, color=COLOURS["other"], alpha=0.15, linewidth=0)
                place = {"xycoords": ("data", "axes fraction"), "ha": "right", "fontsize": 8}
                axes.annotate("copies exceed the link", (self.max_consumers, 0.5), **place)
            title = f"{points:,} points, {cloud_bytes(points)[0] / 1000:.0f} kB"
            finish(axes, title, xlabel="consumers", xlim=(0.8, self.max_consumers + 0.2), ylim=(0, None))
            axes.set_xticks(consumers)
        panels[0].set_ylabel("mean latency, s")
        legend_below(figure, 4, panels[0])


def _spelled(trios: dict[int, list[float]], spec: str, unit: str = "") -> str:
    """Format the numbers of ``NAMES`` for each number of points."""
    return "; ".join(f"{p:,} points {' / '.join(format(x, spec) for x in trio)}{unit}" for p, trio in trios.items())
