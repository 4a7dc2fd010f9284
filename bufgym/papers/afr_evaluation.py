"""Base of the figures about the link of the AFR paper's evaluation, the 4G log car_0002 [vanderhooft2016http2]."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bufgym import traces
from bufgym.ground.errors import BufgymError
from bufgym.papers.figure import Figure, whole
from bufgym.scenario.afr_evaluation import FRAME_BYTES, LINK, PAPER_FRAMES, RATE_HZ
from bufgym.traces import Trace


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
