"""Fig. 3 of the Robofleet paper: latency and throughput against the publish rate of a PointCloud2 at 100 Mbit/s.

Robofleet runs with n_T = 1, where one message is being sent and only the newest waits. It also runs with every topic
no_drop, where all messages wait, as published and as released. Beside it run rosbridge, which sends JSON from an
unbounded queue, and native ROS with a queue of its own. The paper gives no cloud size, round trip or publishing time.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from bufgym.benchmark.rows import Row
from bufgym.traces import steady
from bufgym_papers.figures.figure import COLOURS, finish, legend_below
from bufgym_papers.figures.robofleet_evaluation import MBIT, SHORT, CloudFigure, cloud_bytes, curves, p95, stream
from bufgym_papers.figures.rows import FigureRows, listed

SENDERS = ("robofleet", "no-drop", "no-drop-released", "rosbridge", "ros-native")
TRIO = ("robofleet", "rosbridge", "ros-native")
LOW = 2.0  # Ratio to the latency at the lowest rate up to which a latency is called low
EQUAL = 0.02  # Relative difference up to which latencies count as equal
GROWN = 10.0  # Ratio to the latency at the lowest rate beyond which a latency is called grown


@dataclass(frozen=True)
class Reproduction(CloudFigure):
    """Fig. 3 for these publish rates."""

    rates_hz: Sequence[float] = (5, 10, 20, 30, 40, 50, 60, 70, 80, 90, 100, 120)
    mbit_per_s: float = 100.0  # rate of the link, which is steady
    duration_s: float = 20.0  # publishing time; without drops the latency depends on it

    LIVE = {"rates_hz": (2, 8, 16, 24), "mbit_per_s": 20.0, "duration_s": 3.0, "runs": 1, "live": 1.0}
    SIZE_INCHES = (10.0, 4.4)

    @property
    def link_hz(self) -> float:
        """Clouds per second that the link carries."""
        return self.mbit_per_s * MBIT / cloud_bytes(self.points)[1]

    def simulate(self) -> FigureRows:
        size, link = cloud_bytes(self.points)[1], steady(self.mbit_per_s * MBIT)
        rows = FigureRows()
        for rate, name, seed in product(sorted(self.rates_hz), SENDERS, range(self.runs)):
            sent = self.send(name, (stream("PointCloud2", rate, points=self.points),), link, self.duration_s, seed)
            latency_s = sent.received.latency_s
            received_hz = float((sent.received_s <= self.duration_s).sum() / self.duration_s)
            row: Row = {"sender": name, "publish_hz": rate, "run": seed}
            for column, seconds in (("", latency_s.mean()), ("p95_", p95(latency_s)), ("last_", latency_s[-1])):
                row[f"{column}latency_ms"] = 1e3 * float(seconds)
            row |= {"received_hz": received_hz, "received_mbit_per_s": received_hz * size / MBIT}
            rows.append(row | {"dropped": len(sent) - len(latency_s)})
        return rows

    def tables(self, rows: FigureRows) -> list[str]:
        return [
            "Mean latency, ms:",
            *rows.pivot("publish_hz", "sender", "latency_ms", ".1f", SHORT),
            "",
            "Messages received a second:",
            *rows.pivot("publish_hz", "sender", "received_hz", ".1f", SHORT),
        ]

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        low, high = min(self.rates_hz), max(self.rates_hz)
        at_high = rows.where(publish_hz=high)
        high_ms = {name: at_high.mean("latency_ms", sender=name) for name in SENDERS}
        growth = {name: high_ms[name] / rows.mean("latency_ms", sender=name, publish_hz=low) for name in SENDERS}
        received_hz = at_high.mean("received_hz", sender="robofleet")
        tested = high > self.link_hz
        # Rosbridge is behind already at the lowest rate, because its messages are longer.
        ms, hz = (
            [
                (rate, *(rows.mean(name, sender=sender, publish_hz=rate) for sender in TRIO))
                for rate in sorted(self.rates_hz)
            ]
            for name in ("latency_ms", "received_hz")
        )
        ahead = [rate for rate, own, _, native in ms if own < native * (1 - EQUAL)]
        behind = [rate for rate, own, _, native in ms if own > native * (1 + EQUAL)]
        fewer = [rate for rate, own, _, native in hz if own < native * (1 - EQUAL)]
        return {
            "rosbridge": all(own < bridge for _, own, bridge, _ in ms),
            # Ideal: the link carries all that is published.
            "native": not any(rate <= self.link_hz for rate in ahead) and bool(behind),
            "fewer": listed([f"{rate:g}" for rate in fewer]),
            "ahead_of_native": listed([f"{rate:g}" for rate in ahead]),
            "behind_native": listed([f"{rate:g}" for rate in behind]),
            "some": "; ".join(
                f"{rate:g} Hz {own:.1f} / {bridge:.0f} / {native:.1f} ms"
                for rate, own, bridge, native in ms
                if rate in (low, 40, 60, high)
            ),
            "low": growth["robofleet"] <= LOW and received_hz < high if tested else None,
            "grows": growth["no-drop"] >= GROWN if tested else None,
            "cloud_bytes": cloud_bytes(self.points)[1],
            "paced_hz": 1 / (1 / self.link_hz + self.round_trip_ms / 1e3),
            "high": high,
            "low_hz": low,
            "high_ms": high_ms["robofleet"],
            "high_received_hz": received_hz,
            "growth": growth["robofleet"],
            "no_drop_s": high_ms["no-drop"] / 1e3,
            "no_drop_growth": growth["no-drop"],
            "released_growth": growth["no-drop-released"],
            "last_s": at_high.mean("last_latency_ms", sender="no-drop") / 1e3,
        }

    def draw(self, rows: FigureRows, figure: Any) -> None:
        latency, received = figure.subplots(1, 2)
        high = max(self.rates_hz)
        panels = ((latency, "latency_ms", "Latency"), (received, "received_hz", "Throughput"))
        for axes, name, title in panels:
            curves(axes, rows, "publish_hz", name, SENDERS)
            axes.axvline(self.link_hz, color=COLOURS["oracle"], linestyle="--", linewidth=1)
            finish(axes, title, xlabel="publish rate, Hz", xlim=(0, 1.03 * high))
        received.plot([0, high], [0, high], color=COLOURS["other"], linestyle=":", label="all that is published")
        latency.set(yscale="log", ylabel="mean latency, ms")
        received.set(ylabel="messages received per second", ylim=(0, 1.15 * min(high, self.link_hz)))
        place = {"textcoords": "offset points", "ha": "right", "fontsize": 8}
        received.annotate("the link's rate", (self.link_hz, 0), (-4, 6), **place)
        legend_below(figure, 3, received)
