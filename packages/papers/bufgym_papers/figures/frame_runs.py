"""Recordings, link and runs shared by Fig. 7 and 8 of the AFR paper when frames are really mapped and tracked.

See packages/papers/PERCEPTION.md, "Fig. 7 and 8 of the AFR paper".
"""

import functools
import math
import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product, starmap
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from bufgym import traces
from bufgym.benchmark.bootstrap import Interval, interval, stream, times_drawn
from bufgym.benchmark.rows import Row
from bufgym.scenario.afr_evaluation import LINK, PAPER_FRAMES, fade
from bufgym.scenario.suites import CAPACITIES
from bufgym.traces import Trace
from bufgym.utils.libraries import library
from bufgym_papers.figures.figure import COLOURS, Figure, whole
from bufgym_papers.figures.frame_tasks import FOLDERS, FrameTask, Kind, carry_out, stage
from bufgym_papers.figures.rows import FigureRows
from bufgym_papers.perception import streams
from bufgym_papers.perception.stage import IMAGES, OFFSETS, Stage

RECORDINGS = {"room": "a made-up room", "7-scenes": "7-Scenes, Kinect", "tum": "TUM RGB-D freiburg1_desk, Kinect"}
"""Name -> description of the recording; all but the room need a folder of recordings."""

POLICIES = {
    "drop-oldest": ("Drop Oldest", COLOURS["drop-oldest"]),
    "random": ("Random", COLOURS["random"]),
    IMAGES: ("ORBBuf, images", COLOURS["pink"]),
    "orbbuf": ("ORBBuf, motion", "#882255"),
    "afr": ("AFR", COLOURS["afr"]),
    "min-motion-gap": ("min-motion-gap", COLOURS["orange"]),
    "clairvoyant": ("clairvoyant", COLOURS["oracle-ideal"]),
}
"""Policy -> label, colour. The clairvoyant plans for motion QoI."""
RESAMPLES = 1000  # Of the bootstrap over the places of the fade


class FrameRun(NamedTuple):
    """One run: the recording, the fade's offset k, the queue size L and the policy."""

    recording: str
    k: int
    L: int
    policy: str


@dataclass(frozen=True)
class FrameFigure(Figure):
    """A figure with a run of every policy at each L and fade offset on each recording."""

    data: Path | None = None  # folder of recordings; None uses only the made-up room and fade
    frames: int = PAPER_FRAMES
    capacities: Sequence[int] = CAPACITIES
    policies: Sequence[str] = tuple(POLICIES)
    offsets: int = OFFSETS  # runs of the sweep; each shifts the fade earlier by a tenth of the stream
    jobs: int = -1  # parallel processes; -1 starts one per core
    store: Path | None = None  # folder of the finished tasks' results; None keeps nothing

    RULES = {"frames": whole(30), "offsets": whole(1, OFFSETS), "jobs": whole(-1)}

    @property
    def _folder(self) -> str | None:
        return None if self.data is None else str(self.data)

    @property
    def recordings(self) -> list[str]:
        data = self.data
        return ["room", *(name for name, folder in FOLDERS.items() if data is not None and (data / folder).is_dir())]

    @cached_property
    def link(self) -> Trace:
        """The paper's link if its recording is available, otherwise the made-up fade."""
        path = None if self.data is None else self.data / LINK
        return fade() if path is None or not path.is_file() else traces.read_trace(path)

    def stage(self, recording: str) -> Stage:
        return stage(recording, self._folder, self.frames)

    def x_of(self, recording: str) -> NDArray[np.float64]:
        """Coordinate of each frame, float64[frames]."""
        whole = self.stage(recording).whole
        return whole.motion().at(whole.time_us)

    def of_each(self, texts: Iterable[str]) -> str:
        """Join the sentences about each recording, in order."""
        return "; ".join(map(" ".join, zip(self.recordings, texts, strict=True)))

    def settings(self) -> list[FrameRun]:
        return list(starmap(FrameRun, product(self.recordings, range(self.offsets), self.capacities, self.policies)))

    @cached_property
    def _results(self) -> dict[FrameTask, Row]:
        return {}

    def done(self, *tasks: FrameTask) -> list[Row]:
        missing = [task for task in tasks if task not in self._results]
        jobs = self.jobs if len(missing) > 1 else 1
        self._results.update(carry_out(missing, self._folder, self.link, self.store, jobs))
        return [self._results[task] for task in tasks]

    def task(self, kind: Kind, setting: FrameRun) -> FrameTask:
        about = (setting.policy, self.link.name, setting.k, setting.L) if kind == "kept" else self.kept(setting)
        return FrameTask(kind, setting.recording, self.frames, about)

    def kept(self, setting: FrameRun) -> tuple[int, ...]:
        """The frames that arrive in this run."""
        (row,) = self.done(self.task("kept", setting))
        return cast(tuple[int, ...], row["kept"])

    def play(self, *kinds: Kind) -> FigureRows:
        """Return a row for each run: its frame count and its results of these tasks."""
        settings = self.settings()
        self.done(*(self.task("kept", setting) for setting in settings))
        parts = [self.done(*(self.task(kind, setting) for setting in settings)) for kind in kinds]
        rows = FigureRows()
        for setting, *found in zip(settings, *parts, strict=True):
            row: Row = setting._asdict() | {"received": len(self.kept(setting))}
            rows.append(functools.reduce(operator.or_, found, row))
        return rows

    @property
    def about(self) -> str:
        """Describe the recordings and the link in sentences."""
        parts = []
        for recording in self.recordings:
            whole = self.stage(recording).whole
            sizes, end_us = streams.sizes(whole), int(whole.time_us[-1])
            carried = self.stage(recording).episode(self.link, 0).link.carried_at(end_us) / float(sizes.sum())
            frames = f"{len(whole)} frames of {sizes.mean() / 1e3:.0f} kB in {end_us / 1e6:.1f} s"
            link = f"of which the link {self.link.name} carries {carried:.0%}"
            parts.append(f"{recording}: {RECORDINGS[recording]}, {frames}, {link}.")
        return "\n\n".join(parts)


def over_places(
    numbers: Sequence[float] | NDArray[np.float64], label: str, units: float | NDArray[np.float64] = 1.0
) -> Interval:
    """Divide the sum of the numbers, one of each place of the fade, by that of their units: by default their mean.

    The interval comes from a paired bootstrap over places: a drawn one brings all its runs.
    """
    drawn = times_drawn(len(numbers), RESAMPLES, stream(0, label))
    return interval(drawn @ np.asarray(numbers) / (drawn * units).sum(axis=1), len(numbers))


def spearman(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Correlate two samples by rank; the result is in [-1, 1], or NaN if one sample does not vary."""
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return math.nan
    return float(library("scipy.stats", "bufgym-papers[perception]").spearmanr(a, b).statistic)
