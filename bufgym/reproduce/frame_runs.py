"""What Fig. 7 and 8 of the AFR paper share when frames are really mapped and tracked: recordings, link, runs.

The paper streams 794 RGB-D frames at 30 Hz over car_0002. Here the same number of frames comes from a recording of a
Kinect (7-Scenes, with ``--data``) and from a made-up room, each as long as it really is when encoded. The link is that
of the paper (with ``--data``; a made-up fade without) for as long as the stream lasts, and then again.

Where the fade meets the camera's motion decides much. The paper shows one *alignment*: the link begins with the stream.
Beside it stands a sweep that was fixed before anything had been run: the link begins k tenths of the stream later, so
the fade comes earlier by as much, k = 0 .. ``offsets`` - 1; k = 0 is the paper's.

Each run is one task: a recording, and the numbers of the frames that arrived. What a task gave is kept in a file by
these alone. So figures share their runs, equal runs are run once, and what was killed goes on where it was.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym import __version__, traces
from bufgym.benchmark import cluster
from bufgym.benchmark.run import bar
from bufgym.errors import BufgymError
from bufgym.perception import frames as depth_frames
from bufgym.perception import mapping, orb, room, streams, tracking, views
from bufgym.reproduce.afr_evaluation import LINK, PAPER_FRAMES, STYLES
from bufgym.reproduce.figure import COLOURS, Figure, several, whole
from bufgym.reproduce.rows import Row, Rows
from bufgym.scenario import Episode
from bufgym.scenario.suites import CAPACITIES, motion_value, time_value
from bufgym.traces import Trace

RECORDINGS = {"room": "a made-up room", "7-scenes": "7-Scenes, Kinect"}
"""Name -> what it is; the second needs a folder of recordings."""
SEVEN_SCENES = "rgbd_7scenes"
MAP_WIDTH, TRACK_WIDTH = 160, 80
"""Frames are mapped at 160 x 120 and tracked at 80 x 60, which fails where 160 x 120 does, in a third of the time."""
OFFSETS = 10

IMAGES = "orbbuf-images"
"""ORBBuf by the images themselves: a policy of each episode, not registered."""
POLICIES = {
    "drop-oldest": STYLES["drop-oldest"],
    "random": STYLES["random"],
    IMAGES: ("ORBBuf, images", COLOURS["pink"], "D"),
    "orbbuf": ("ORBBuf, motion", "#882255", "d"),
    "afr": STYLES["afr"],
    "min-motion-gap": ("min-motion-gap", COLOURS["orange"], "v"),
    "learned-motion": ("learned-motion", COLOURS["sky"], "P"),
    "clairvoyant": ("clairvoyant", COLOURS["oracle-ideal"], "*"),
}
"""Policy -> label, colour, marker. The clairvoyant plans for motion QoI."""

Kind = Literal["images", "map", "track"]


def fade() -> Trace:
    """In place of the paper's link: 2.2 MB/s, which is about its mean, and 0.4 from second 21 to second 24."""
    return Trace.steps([(21, 2.2e6), (3, 0.4e6), (30, 2.2e6)], name="fade")


# --- one recording ---------------------------------------------------------------------------------------------------


class Stage:
    """A recording at the size at which it is mapped and tracked, and what every run on it needs."""

    def __init__(self, name: str, data: str | None, frames: int) -> None:
        if name == "room":
            whole_size = room.room(0, frames=frames)
        elif data is None:
            raise BufgymError(f"recording {name}: needs a folder of recordings (--data DIR) with {SEVEN_SCENES}")
        else:
            whole_size = depth_frames.open_sequence(Path(data) / SEVEN_SCENES)
        self.whole = streams.first(whole_size, frames)
        self.sequence = self.whole.reduced(self.whole.camera.width // MAP_WIDTH).loaded()
        self.small = self.sequence.reduced(MAP_WIDTH // TRACK_WIDTH).loaded()

    @cached_property
    def grid(self) -> mapping.Grid:
        """Of every map."""
        return mapping.grid_of(self.sequence)

    @cached_property
    def reference(self) -> mapping.Map:
        """The map of all frames."""
        return mapping.fuse(self.sequence, range(len(self.sequence)), self.grid)

    @cached_property
    def tracked_reference(self) -> mapping.Map:
        """The map that tracking makes of all frames, drift included."""
        return tracking.track(self.small, range(len(self.small)), self.grid).model

    @cached_property
    def similar(self) -> orb.OrbSimilarity:
        """Of the images, as the sender has them."""
        return orb.OrbSimilarity(self.whole.grey)

    @cached_property
    def seen(self) -> NDArray[np.float32]:
        """See ``views.seen_shares``."""
        return views.seen_shares(self.small)

    @cached_property
    def coverage(self) -> views.Coverage:
        """Of its scene."""
        return views.Coverage(self.small)

    def episode(self, trace: Trace, k: int) -> Episode:
        """The stream over this link, the fade k tenths of it earlier than in the paper."""
        stream_us = int(self.whole.time_us[-1])
        link = streams.fading(stream_us, trace, k * stream_us // OFFSETS)
        return streams.episode(self.whole, streams.sizes(self.whole), link, seed=k)

    def mapped(self, kept: Sequence[int]) -> Row:
        """Error of the map of these frames with their true poses."""
        return errors(mapping.error(mapping.fuse(self.sequence, kept, self.grid), self.reference))

    def tracked(self, kept: Sequence[int]) -> Row:
        """Where tracking along these frames breaks, and how far the map that it made till then is from that which it
        makes of all frames: both drift alike, so what differs is due to the frames that are missing."""
        track = tracking.track(self.small, kept, self.grid)
        found = errors(mapping.error(track.model, self.tracked_reference))
        row: Row = {"failed": track.failed, "failed_at": track.where}
        return row | {f"slam_{name}": number for name, number in found.items()}


def errors(error: mapping.MapError) -> Row:
    """A map's error in mm, and what of the scene it lacks."""
    return {
        "rmse_mm": 1e3 * error.rmse_m,
        "to_reference_mm": 1e3 * error.to_reference_m,
        "from_reference_mm": 1e3 * error.from_reference_m,
        "uncovered": error.uncovered,
    }


@functools.lru_cache(maxsize=2)
def stage(name: str, data: str | None, frames: int) -> Stage:
    """One for each process: to open a recording takes seconds."""
    return Stage(name, data, frames)


# --- tasks -----------------------------------------------------------------------------------------------------------


class Task(NamedTuple):
    """What is to be found out: the map or the track of some frames of a recording, or which ones ORBBuf keeps."""

    kind: Kind
    recording: str
    data: str | None
    frames: int
    about: tuple[int, ...]
    """The frames; of ``images`` (k, L): the offset of the fade, and the queue."""
    trace: Trace
    """The link."""

    @property
    def key(self) -> str:
        """Tells it from all others, wherever the data lie; maps and tracks depend on their frames alone."""
        link = self.trace.name if self.kind == "images" else ""
        text = f"{__version__} {self.kind} {self.recording} {self.frames} {self.about} {link}"
        return hashlib.sha256(text.encode()).hexdigest()[:24]


def carried_out(task: Task) -> tuple[str, Row]:
    """The task's key and what it gave."""
    on = stage(task.recording, task.data, task.frames)
    if task.kind == "images":
        k, L = task.about
        one = on.episode(task.trace, k)
        return task.key, {"kept": streams.received(orb.orbbuf_by(on.similar, one), one, L)}
    return task.key, on.mapped(task.about) if task.kind == "map" else on.tracked(task.about)


class Store:
    """Results of tasks by their keys, in memory and, if ``path`` is given, a line each in a file."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._held: dict[str, Row] = {}
        if path is not None and path.exists():
            for line in path.read_text(encoding="utf-8").splitlines():
                try:
                    key, row = json.loads(line)
                except ValueError:
                    continue  # the line that a kill cut short
                self._held[key] = row

    def __contains__(self, task: Task) -> bool:
        return task.key in self._held

    def __getitem__(self, task: Task) -> Row:
        return self._held[task.key]

    def add(self, key: str, row: Row) -> None:
        """Keep what a task gave."""
        self._held[key] = row
        if self._path is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps([key, row]) + "\n")


def carry_out(tasks: Iterable[Task], store: Store, jobs: int) -> None:
    """Carry out what the store does not have yet; each task once."""
    missing = list({task.key: task for task in tasks if task not in store}.values())
    if not missing:
        return
    with bar(len(missing), show=True, unit="run") as advance:
        for key, row in _spread(missing, jobs):
            store.add(key, row)
            advance(1)


def _spread(tasks: Sequence[Task], jobs: int) -> Iterator[tuple[str, Row]]:
    if jobs == 1:
        yield from map(carried_out, tasks)
    else:
        calls = ((carried_out, (task,)) for task in tasks)
        yield from cluster.spread(calls, len(tasks), jobs, "loky", None)


# --- the figures -----------------------------------------------------------------------------------------------------


class Setting(NamedTuple):
    """One run: which policy, with which queue, on which recording, with the fade where."""

    recording: str
    k: int
    L: int
    policy: str


@dataclass(frozen=True)
class FrameFigure(Figure):
    """A figure of runs of every policy at each L, on each recording and with the fade at each offset."""

    data: Path | None = None
    """Folder of recordings; without one the made-up room and a made-up fade alone."""
    frames: int = PAPER_FRAMES
    capacities: Sequence[int] = CAPACITIES
    policies: Sequence[str] = tuple(POLICIES)
    offsets: int = OFFSETS
    """Runs of the sweep; the fade comes a tenth of the stream earlier in each."""
    jobs: int = -1
    """Processes side by side; -1: one a core."""
    store: Path | None = None
    """File of the tasks that have been carried out; None keeps nothing."""

    RULES = {"frames": whole(30), "capacities": several(whole()), "offsets": whole(1, OFFSETS)}

    @property
    def recordings(self) -> list[str]:
        """Those that are there."""
        real = self.data is not None and (self.data / SEVEN_SCENES).is_dir()
        return ["room", *(["7-scenes"] if real else [])]

    @cached_property
    def link(self) -> Trace:
        """The paper's where it is there."""
        path = None if self.data is None else self.data / LINK
        return fade() if path is None or not path.is_file() else traces.read_trace(path)

    def stage(self, recording: str) -> Stage:
        """The recording, opened once."""
        return stage(recording, None if self.data is None else str(self.data), self.frames)

    def settings(self) -> list[Setting]:
        """Every run, in the order of the rows."""
        return [
            Setting(recording, k, L, policy)
            for recording in self.recordings
            for k in range(self.offsets)
            for L in self.capacities
            for policy in self.policies
        ]

    @cached_property
    def done(self) -> Store:
        """What has been carried out."""
        return Store(self.store)

    def task(self, kind: Kind, setting: Setting) -> Task:
        """What is to be found out of this run."""
        data = None if self.data is None else str(self.data)
        about = (setting.k, setting.L) if kind == "images" else self.kept(setting)
        return Task(kind, setting.recording, data, self.frames, about, self.link)

    def kept(self, setting: Setting) -> tuple[int, ...]:
        """The frames that arrive in this run."""
        if setting.policy == IMAGES:
            task = self.task("images", setting)
            carry_out([task], self.done, 1)
            return tuple(self.done[task]["kept"])
        if setting not in self._kept:
            one = self.stage(setting.recording).episode(self.link, setting.k)
            self._kept[setting] = streams.received(setting.policy, one, setting.L)
        return self._kept[setting]

    @cached_property
    def _kept(self) -> dict[Setting, tuple[int, ...]]:
        return {}

    def play(self, *kinds: Kind) -> Rows:
        """A row for each run: its frames, its information by each V, and what the tasks of these kinds gave."""
        settings = self.settings()
        carry_out([self.task("images", one) for one in settings if one.policy == IMAGES], self.done, self.jobs)
        carry_out([self.task(kind, setting) for kind in kinds for setting in settings], self.done, self.jobs)
        rows = Rows()
        for setting in settings:
            row: Row = setting._asdict() | {"received": len(self.kept(setting))} | self.information(setting)
            for kind in kinds:
                row |= self.done[self.task(kind, setting)]
            rows.append(row)
        return rows

    def information(self, setting: Setting) -> Row:
        """H of the run's frames by time, by motion and by measured overlap, and what of the scene they cover."""
        kept, on = self.kept(setting), self.stage(setting.recording)
        x = on.episode(self.link, 0).arrivals["x"][list(kept)]
        return {
            "H_time": time_value().information(np.array(kept, np.float64)),
            "H_motion": motion_value().information(x),
            "H_overlap": views.overlap_information(on.seen, kept),
            "coverage": on.coverage.share(kept),
        }

    def about(self) -> str:
        """What meets the policies, in sentences."""
        parts = []
        for recording in self.recordings:
            whole = self.stage(recording).whole
            size_kb = float(streams.sizes(whole).mean()) / 1e3
            seconds = float(whole.time_us[-1]) / 1e6
            carried = self.stage(recording).episode(self.link, 0).link.carried_at(int(whole.time_us[-1]))
            demand = float(streams.sizes(whole).sum())
            parts.append(
                f"{recording}: {RECORDINGS[recording]}, {len(whole)} frames of {size_kb:.0f} kB in {seconds:.1f} s, "
                f"of which the link {self.link.name} carries {carried / demand:.0%}."
            )
        return "\n\n".join(parts)
