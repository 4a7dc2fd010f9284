"""Fig. 6 of the AFR paper: bandwidth of the 4G log car_0002 [vanderhooft2016http2] against the camera's demand.

Samples are numbered from 0, as the paper counts seconds. The paper's "about 15 MB/s" describes 4G in general. It is no
claim about this trace.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import traces
from bufgym.scenario.afr_evaluation import FRAME_BYTES, LINK, PAPER_FRAMES, RATE_HZ
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError
from bufgym_papers.figures.figure import COLOURS, Figure, finish, legend_below, whole
from bufgym_papers.figures.rows import FigureRows, listed

PAPER_LOW = [21, 23]  # Seconds under 500 KB/s according to the paper, counted from 0
LOW = 500e3  # Bytes/s


@dataclass(frozen=True)
class LinkFigure(Figure):
    """A figure in which ``frames`` frames of ``size_bytes`` are sent over the link."""

    data: Path | None = None  # folder of recordings, with belgium_4g/csv/report_car_0002.csv
    trace: str | None = None  # trace to use in place of car_0002: a shipped name or a file
    frames: int = PAPER_FRAMES
    size_bytes: int = FRAME_BYTES

    RULES = {"frames": whole(2)}

    @cached_property
    def link(self) -> Trace:
        if self.trace is not None:
            return traces.load(self.trace)
        if self.data is None:
            raise BufgymError(f"the AFR paper's evaluation needs a folder of recordings (--data DIR) with {LINK}")
        if not (self.data / LINK).is_file():
            raise BufgymError(f"{self.data / LINK}: no such file; the AFR paper's evaluation needs it")
        return traces.read_trace(self.data / LINK)

    @property
    def streamed(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Lengths in us and rates in bytes/s of the link samples that begin while frames arrive."""
        lengths_us, rates = self.link.samples()
        during = np.cumsum(lengths_us) - lengths_us < self.frames / RATE_HZ * 1e6
        return lengths_us[during], rates[during]


@dataclass(frozen=True)
class Reproduction(LinkFigure):
    """Fig. 6; the picture shows the first ``show_s`` seconds and the whole trace."""

    show_s: float = 60.0

    SIZE_INCHES = (7.5, 5.2)

    def simulate(self) -> FigureRows:
        lengths_us, rates = self.link.samples()
        ends_s = np.cumsum(lengths_us) / 1e6
        return FigureRows(
            {
                "second": k,
                "start_s": round(float(end_s - length_us / 1e6), 6),
                "end_s": round(float(end_s), 6),
                "bytes_per_s": float(rate),
                "under_500KBps": bool(rate < LOW),
                "streamed": k < len(self.streamed[1]),
            }
            for k, (length_us, end_s, rate) in enumerate(zip(lengths_us, ends_s, rates, strict=True))
        )

    @property
    def demand(self) -> float:
        """Bytes/s."""
        return RATE_HZ * self.size_bytes

    def tables(self, rows: FigureRows) -> list[str]:
        return [
            f"Second {row['second']}: {row['bytes_per_s'] / 1e3:.1f} KB/s, from {row['start_s']:.2f} to "
            f"{row['end_s']:.2f} s of the trace."
            for row in rows.where(under_500KBps=True, streamed=True)
        ]

    def claims(self, rows: FigureRows) -> dict[str, Any]:
        rates = rows.column("bytes_per_s", streamed=True)
        best, best_of_all = float(rates.max()), float(rows.column("bytes_per_s").max())
        low_seconds = [row["second"] for row in rows.where(under_500KBps=True, streamed=True)]
        low_of_all = rows.where(under_500KBps=True).distinct("second")
        return {
            "low-seconds": low_seconds == PAPER_LOW,
            "overload": bool((rates < self.demand).all()),
            "duration_s": self.link.duration_us / 1e6,
            "stream_s": self.frames / RATE_HZ,
            "low_seconds": listed(low_seconds),
            "low_of_all": len(low_of_all),
            "all_low_seconds": listed(low_of_all),
            "seconds": len(rates),
            "seconds_of_all": len(rows),
            "best": best / 1e6,
            "best_of_all": best_of_all / 1e6,
            "demand": self.demand / 1e6,
            "frame_kb": self.size_bytes / 1e3,
            "under": int((rates < self.demand).sum()),
            "carried": float(np.average(rates, weights=self.streamed[0])) / self.demand,
        }

    def draw(self, rows: FigureRows, figure: Any) -> None:
        panels = figure.subplots(2, 1, height_ratios=[2, 1])
        rates, edges = rows.column("bytes_per_s") / 1e6, np.append(rows.column("start_s"), rows[-1]["end_s"])
        for axes, until_s in zip(panels, (min(self.show_s, edges[-1]), edges[-1]), strict=True):
            axes.stairs(rates, edges, color=COLOURS["afr"], linewidth=1.2, label=self.link.name)
            demand = self.demand / 1e6
            axes.axhline(demand, color=COLOURS["drop-oldest"], linewidth=1.4, label=f"demand {demand:g} MB/s")
            axes.axvspan(0, self.frames / RATE_HZ, color=COLOURS["other"], alpha=0.13, linewidth=0, label="stream")
            for k, row in enumerate(rows.where(under_500KBps=True)):
                label = "under 500 KB/s" if k == 0 else None
                axes.axvspan(row["start_s"], row["end_s"], color=COLOURS["drop-oldest"], alpha=0.35, label=label)
            finish(axes, xlim=(0, until_s), ylim=(0, 1.06 * max(rates.max(), demand)), ylabel="MB/s")
        panels[0].set_title(f"{self.link.name}: the first {self.show_s:g} s, and all of it", loc="left", fontsize=10)
        panels[1].set_xlabel("time since the trace's start, s")
        legend_below(figure, 4, panels[1])
