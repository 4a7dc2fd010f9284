"""Camera stream, link, camera motion and policies shared by Fig. 6, 7 and 8 of the AFR paper.

The paper streams 794 RGB-D frames at 30 Hz over the Belgium 4G log car_0002 [vanderhooft2016http2], ten times for each
policy and queue size. It evaluates mapping (Fig. 7) and tracking (Fig. 8) on the frames received. No SLAM runs here: we
count the Quantity of Information and the longest motion gap. The camera motions come from [sturm2012tum].

The paper does not state the size of a frame. A size of about 160 kB reproduces the paper's numbers (see
`afr_frame_size`). The figures also show a sweep of sizes.

The ten runs differ in three ways: where in the camera's recording they begin, the jitter of each frame within a tenth
of its period, and the uniform draws of Random. Every policy meets the same ten runs. In all of them the link begins at
the trace's start. Frames have equal sizes, because the clairvoyant is exact only for equal sizes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym import policies, traces
from bufgym.benchmark.run import run
from bufgym.ground.errors import BufgymError
from bufgym.papers.figure import COLOURS, Figure, whole
from bufgym.papers.rows import Rows
from bufgym.scenario import Uplink
from bufgym.scenario.suites import CAPACITIES, RATE_HZ, motion_value, time_value
from bufgym.traces import Motion, Trace

PAPER_FRAMES = 794
PAPER_RUNS = 10
FRAME_BYTES = 160_000
"""Size of a frame that roughly reproduces the paper's recalculations and frame rates."""
SWEEP_KB = (140, 180, 200, 230)
"""Further frame sizes that the figures show, kB."""

LINK = "belgium_4g/csv/report_car_0002.csv"
CAMERA = "tum_rgbd/{}.groundtruth.txt.gz"
CAMERAS = ("freiburg1_desk", "freiburg2_desk")
"""A hand-held camera over a desk, moving at 0.8 and at 0.27 fields of view a second."""
JITTER = 0.1
"""Largest delay of a frame, as a fraction of its period."""

STYLES = {
    "afr": ("AFR", COLOURS["afr"], "o"),
    "drop-oldest": ("Drop Oldest", COLOURS["drop-oldest"], "s"),
    "random": ("Random", COLOURS["random"], "^"),
    "orbbuf": ("ORBBuf", COLOURS["pink"], "D"),
    "min-motion-gap": ("min-motion-gap (not in the paper)", COLOURS["orange"], "v"),
}
"""Policy -> label, colour, marker."""
COLUMNS = {"L": "capacity", "policy": "policy", "run": "seed", "H": "qoi", "H_clairvoyant": "clairvoyant"}
COLUMNS |= {"regret": "regret", "longest_gap_views": "longest_gap", "longest_gap_s": "longest_gap_s"}
"""Column of the figures -> column of the benchmark's rows."""


class StreamSetting(NamedTuple):
    """Scenario that the policies meet in one part of a figure; the camera is "time" where x is the frame index."""

    camera: str
    size_kb: float
    uplink: Uplink


@dataclass(frozen=True)
class LinkFigure(Figure):
    """A figure in which ``frames`` frames of ``size_bytes`` are sent over the link."""

    data: Path | None = None
    """Folder of recordings, with belgium_4g/csv/report_car_0002.csv."""
    trace: str | None = None
    """Trace to use in place of car_0002: a shipped name or a file."""
    frames: int = PAPER_FRAMES
    size_bytes: int = FRAME_BYTES

    RULES = {"frames": whole(2)}

    @cached_property
    def link(self) -> Trace:
        if self.trace is not None:
            return traces.load(self.trace)
        return traces.read_trace(_recording(self.data, LINK))

    @property
    def streamed(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Lengths in us and rates in bytes/s of the link samples that begin while frames arrive."""
        lengths_us, rates = self.link.samples()
        during = np.cumsum(lengths_us) - lengths_us < self.frames / RATE_HZ * 1e6
        return lengths_us[during], rates[during]

    def share_carried(self) -> float:
        """Fraction of the demand that the link can carry while the frames arrive."""
        lengths_us, rates = self.streamed
        return float(np.average(rates, weights=lengths_us)) / (RATE_HZ * self.size_bytes)


@dataclass(frozen=True)
class StreamFigure(LinkFigure):
    """A figure with ``runs`` runs of every policy over each link and camera."""

    motion: str | Sequence[str] = CAMERAS
    """TUM RGB-D sequences in ``data`` (tum_rgbd/*.groundtruth.txt.gz), shipped motions or files."""
    capacities: Sequence[int] = CAPACITIES
    runs: int = PAPER_RUNS
    sweep_kb: Sequence[float] = SWEEP_KB
    """Further frame sizes, kB."""

    @cached_property
    def cameras(self) -> list[Motion]:
        names = [self.motion] if isinstance(self.motion, str) else self.motion
        return [load_camera(name, self.data) for name in names]

    @property
    def size_kb(self) -> float:
        """Size of a frame in the main part of the figure, kB."""
        return self.size_bytes / 1000

    def settings(self, *, timed: bool) -> list[StreamSetting]:
        """List every frame size with every camera, and with time-based QoI if ``timed``."""
        settings = []
        for size_kb in sorted({self.size_kb, *self.sweep_kb}):
            uplink = Uplink(
                traces=(self.link,),
                rate_hz=RATE_HZ,
                jitter=JITTER,
                size_bytes=round(1000 * size_kb),
                size_cv=0.0,
                duration_s=self.frames / RATE_HZ,
                link_offset_s=(0.0, 0.0),
                value=time_value(),
            )
            for camera in self.cameras:
                moving = replace(uplink, motion=(camera,), value=motion_value())
                settings.append(StreamSetting(camera.name, size_kb, moving))
            if timed:
                settings.append(StreamSetting("time", size_kb, uplink))
        return settings

    def play(self, settings: Sequence[StreamSetting], runs: int, *, bound: bool) -> Rows:
        """Return a row for each setting, policy and run; ``bound`` adds the clairvoyant's H and the regret."""
        chosen = [policies.get(name) for name in STYLES]
        rows = Rows()
        for setting in settings:
            for row in run(chosen, setting.uplink, self.capacities, runs, bound=bound):
                found = {column: row[name] for column, name in COLUMNS.items()}
                rows.append({"size_kb": setting.size_kb, "camera": setting.camera, **found})
        return rows

    def about(self) -> str:
        """Describe the scenario in sentences."""
        return (
            f"{self.frames} frames of {self.size_bytes / 1000:g} kB at {RATE_HZ:g} Hz, equal in size, over "
            f"{self.link.name} from its start: it carries {self.share_carried():.0%} of the demand. {self.runs} runs "
            f"each, which differ by their start on the camera's recording, by arrival jitter (up to {JITTER:.0%} of a "
            "period), and by Random's uniform draws."
        )


def load_camera(name: str, data: Path | None) -> Motion:
    """Load a shipped motion or a file with this name, or else a TUM RGB-D sequence from the folder of recordings."""
    if name in traces.shipped() or Path(name).is_file():
        return traces.load_motion(name)
    return replace(traces.read_motion(_recording(data, CAMERA.format(name))), name=name)


def _recording(data: Path | None, name: str) -> Path:
    if data is None:
        raise BufgymError(f"the AFR paper's evaluation needs a folder of recordings (--data DIR) with {name}")
    if not (data / name).is_file():
        raise BufgymError(f"{data / name}: no such file; the AFR paper's evaluation needs it")
    return data / name
