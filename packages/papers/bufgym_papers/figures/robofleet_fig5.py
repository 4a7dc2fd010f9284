"""Fig. 5 of the Robofleet paper: latency and throughput while capacity falls evenly from 100 to 4 Mbit/s in 15 s.

The paper gives neither size nor rate of its PointCloud2 topic; Robofleet's example client allows a cloud 10 Hz. A
latency is plotted at the second in which its message was received. The link stays at its last rate for a while, so that
late messages are received too. A program breaks in the first second whose mean latency exceeds `BROKEN` times the time
that one message needs alone at the capacity of that second.
"""

import math
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from bufgym.benchmark.rows import Row
from bufgym.traces import ramp
from bufgym.utils.errors import BufgymError
from bufgym_papers.figures.figure import COLOURS, at_least_0, finish, legend_below
from bufgym_papers.figures.robofleet_evaluation import JITTER, MBIT, SHORT, CloudFigure, cloud_bytes, curves, stream
from bufgym_papers.figures.rows import FigureRows, average

SENDERS = ("robofleet", "no-drop", "rosbridge", "ros-native")
OTHERS = {"bridge": "rosbridge", "no_drop": "no-drop", "native": "ros-native"}
BROKEN = 2.0


@dataclass(frozen=True)
class Reproduction(CloudFigure):
    """Fig. 5 for this publish rate."""

    rate_hz: float = 10.0
    from_mbit_per_s: float = 100.0
    to_mbit_per_s: float = 4.0
    fall_s: float = 15.0  # time over which capacity falls
    stay_s: float = 5.0  # time at the last capacity, during which messages still arrive
    RULES = {"stay_s": at_least_0}
    LIVE = dict(rate_hz=5.0, points=5_000, from_mbit_per_s=25.0, to_mbit_per_s=1.0, stay_s=3.0, runs=1, live=1.0)
    """Options of a live run: a quarter of the bytes per second over a quarter of the link."""
    SIZE_INCHES = (7.5, 5.8)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.until_s < 2:
            raise BufgymError(f"fall_s + stay_s = {self.until_s}: must be at least 2")

    @property
    def until_s(self) -> float:
        """Time of the last message's arrival."""
        return self.fall_s + self.stay_s

    def capacity(self, at_s: float) -> float:
        """Capacity of the link, Mbit/s."""
        return self.from_mbit_per_s + (self.to_mbit_per_s - self.from_mbit_per_s) * min(at_s / self.fall_s, 1)

    def simulate(self) -> FigureRows:
        link = ramp(self.from_mbit_per_s * MBIT, self.to_mbit_per_s * MBIT, self.fall_s)
        streams = (stream("PointCloud2", self.rate_hz, points=self.points),)
        rows = FigureRows()
        for name, seed in product(SENDERS, range(self.runs)):
            received = self.send(name, streams, link, self.until_s, seed, watched_s=math.ceil(self.until_s)).received
            for second in range(math.ceil(self.until_s)):
                within = (second <= received.received_s) & (received.received_s < second + 1)
                latency_s = received.latency_s[within]
                row: Row = {"sender": name, "run": seed, "second": second}
                row |= {"link_mbit_per_s": self.capacity(second + 0.5), "received": len(latency_s)}
                highest_s = float(latency_s.max()) if len(latency_s) else math.nan
                rows.append(row | {"mean_latency_s": average(latency_s), "max_latency_s": highest_s})
        return rows

    def tables(self, rows: FigureRows) -> list[str]:
        links = [{**row, "sender": "link", "received": row["link_mbit_per_s"]} for row in rows.where(run=0)]
        received = FigureRows([*rows, *links]).pivot("second", "sender", "received", ".1f", SHORT | {"link": "Mbit/s"})
        return [
            "Received in each second, and the link's Mbit/s in its middle:",
            *received,
            "",
            "Mean latency of these, s:",
            *rows.pivot("second", "sender", "mean_latency_s", ".3f", SHORT),
        ]

    def broken(self, rows: FigureRows, name: str) -> int | None:
        """Find the second in which this program breaks; None if it never does."""
        size = dict(zip(("ros-native", "robofleet", "rosbridge"), cloud_bytes(self.points), strict=True))
        for second in rows.distinct("second"):
            link_s = size.get(name, size["robofleet"]) / (self.capacity(second + 0.5) * MBIT)
            alone_s = link_s + self.round_trip_ms / 2e3
            if rows.mean("mean_latency_s", sender=name, second=second) > BROKEN * alone_s:
                return int(second)
        return None

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        ros, size, _ = cloud_bytes(self.points)
        last_s = size / (self.to_mbit_per_s * MBIT)
        # A message sent is at most one period old, plus jitter, because a newer one would have overwritten it.
        bound_s = last_s + (1 + JITTER) / self.rate_hz + self.round_trip_ms / 2e3
        published = self.runs * self.rate_hz * self.until_s
        share = {name: rows.column("received", sender=name).sum() / published for name in SENDERS}
        highest_s = {name: float(np.nanmax(rows.column("max_latency_s", sender=name))) for name in SENDERS}
        broken = {name: self.broken(rows, name) for name in SENDERS}
        bridge, native, own = (broken[name] for name in ("rosbridge", "ros-native", "robofleet"))
        return {
            "order": bridge is not None and native is not None and bridge < native and own is None,
            "breaks": "; ".join(
                f"{SHORT[name]} {'never' if second is None else f'in second {second}'}"
                for name, second in broken.items()
            ),
            "json_demand": self.rate_hz * cloud_bytes(self.points)[2] / MBIT,
            "low": bool(highest_s["robofleet"] <= bound_s and share["robofleet"] < 1),
            "cloud_bytes": size,
            "ros_bytes": ros,
            "demand": self.rate_hz * size / MBIT,
            "last_s": last_s,
            "bound_s": bound_s,
            "highest_s": highest_s["robofleet"],
            "share": share["robofleet"],
            **{f"{key}_s": highest_s[name] for key, name in OTHERS.items()},
            **{f"{key}_share": share[name] for key, name in OTHERS.items()},
        }

    def draw(self, rows: FigureRows, figure: Any) -> None:
        latency, rate = figure.subplots(2, 1, sharex=True)
        middles = FigureRows(row | {"second": row["second"] + 0.5} for row in rows)
        for axes, name in ((latency, "mean_latency_s"), (rate, "received")):
            curves(axes, middles, "second", name, SENDERS[::-1], markersize=4.5)
            axes.axvline(self.fall_s, color=COLOURS["other"], linewidth=1)
        fine_s = np.linspace(0, self.until_s, 200)
        carried = [self.capacity(at_s) * MBIT / cloud_bytes(self.points)[1] for at_s in fine_s]
        rate.plot(fine_s, carried, color=COLOURS["oracle"], linestyle="--", linewidth=1.2, label="the link's clouds/s")
        rate.axhline(self.rate_hz, color=COLOURS["other"], linestyle=":", label="published")
        fall = f"Capacity falls from {self.from_mbit_per_s:g} to {self.to_mbit_per_s:g} Mbit/s in {self.fall_s:g} s"
        finish(latency, fall, yscale="log", ylabel="mean latency, s")
        rate.set(ylim=(0, 1.6 * self.rate_hz), xlim=(0, self.until_s))
        finish(rate, ylabel="messages received per second", xlabel="time, s")
        legend_below(figure, 3, rate)
