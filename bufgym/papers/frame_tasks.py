"""Tasks on frames: find which frames of a recording arrive, and build their map and their track.

A file keeps each task's result under a key made of the task's inputs alone. So figures share their runs, equal runs are
played once, and a killed run resumes where it stopped.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym import __version__
from bufgym.benchmark import cluster
from bufgym.benchmark.run import bar
from bufgym.ground.errors import BufgymError
from bufgym.papers.perception import frames as depth_frames
from bufgym.papers.perception import mapping, orb, room, streams, tracking, views
from bufgym.papers.rows import Row
from bufgym.scenario import Episode
from bufgym.traces import Trace

SEVEN_SCENES = "rgbd_7scenes"
WIDTH, VIEW_WIDTH = 160, 80
"""Image widths: frames are mapped and tracked at 160 x 120, and views are compared at 80 x 60. Tracking at 80 x 60
would take two thirds of the time, but it loses runs that are tracked at 160 x 120."""
OFFSETS = 10
"""Number of fade offsets; each shifts the fade earlier by a tenth of the stream."""

IMAGES = "orbbuf-images"
"""ORBBuf that compares images; the policy is made for each episode and is not registered."""
SLOW = (IMAGES, "clairvoyant")
"""Policies that take seconds for a run; finding the frames that they keep is a task of its own."""

Kind = Literal["kept", "map", "track"]


# --- one recording ---------------------------------------------------------------------------------------------------


class Stage:
    """A recording reduced to ``WIDTH``, with everything that runs on it share."""

    def __init__(self, name: str, data: str | None, frames: int) -> None:
        if name == "room":
            whole_size: depth_frames.Sequence = room.room(0, frames=frames)
        elif data is None:
            raise BufgymError(f"recording {name}: needs a folder of recordings (--data DIR) with {SEVEN_SCENES}")
        else:
            whole_size = depth_frames.open_sequence(Path(data) / SEVEN_SCENES)
        self.whole = streams.first(whole_size, frames)
        self.sequence = self.whole.reduced(self.whole.camera.width // WIDTH).loaded()
        self.small = self.sequence.reduced(WIDTH // VIEW_WIDTH).loaded()

    @cached_property
    def grid(self) -> mapping.Grid:
        """Grid of every map."""
        return mapping.grid_of(self.sequence)

    @cached_property
    def reference(self) -> mapping.Map:
        """The map of all frames."""
        return self.map_of(range(len(self.sequence)))

    @cached_property
    def tracked_reference(self) -> mapping.Map:
        """The map that tracking makes of all frames, drift included."""
        return self.track_of(range(len(self.sequence))).model

    @cached_property
    def smooth(self) -> Callable[[int], depth_frames.Depth]:
        """Depth of each frame as tracking smooths it, the same in every run."""
        return functools.cache(lambda k: tracking.smoothed(self.sequence.depth(k)))

    @cached_property
    def similar(self) -> orb.OrbSimilarity:
        """Similarity of the images at the sender's full size."""
        return orb.OrbSimilarity(self.whole.grey)

    @cached_property
    def seen(self) -> NDArray[np.float32]:
        """Overlap of views; see ``views.seen_shares``."""
        return views.seen_shares(self.small)

    @cached_property
    def coverage(self) -> views.Coverage:
        """Coverage of the scene."""
        return views.Coverage(self.small)

    def episode(self, trace: Trace, k: int) -> Episode:
        """Make the episode of the stream over this link, with the fade k tenths of the stream earlier."""
        stream_us = int(self.whole.time_us[-1])
        link = streams.fading(stream_us, trace, k * stream_us // OFFSETS)
        return streams.episode(self.whole, streams.sizes(self.whole), link, seed=k)

    def kept(self, policy: str, trace: Trace, k: int, L: int) -> tuple[int, ...]:
        """Play a policy; return the frames that arrive."""
        one = self.episode(trace, k)
        return streams.received(orb.orbbuf_by(self.similar, one) if policy == IMAGES else policy, one, L)

    def map_of(self, kept: Sequence[int]) -> mapping.Map:
        """Build the map of these frames with their true poses."""
        return mapping.fuse(self.sequence, kept, self.grid)

    def track_of(self, kept: Sequence[int]) -> tracking.Track:
        """Track along these frames; the track includes the map made until tracking broke."""
        return tracking.track(self.sequence, kept, self.grid, smooth=self.smooth)

    def mapped(self, kept: Sequence[int]) -> Row:
        """Measure the error of the map of these frames with their true poses."""
        return errors(mapping.error(self.map_of(kept), self.reference))

    def tracked(self, kept: Sequence[int]) -> Row:
        """Track along these frames; report where tracking breaks and the error of its map until then. The reference is
        the tracked map of all frames: both maps drift alike, so they differ by the missing frames."""
        track = self.track_of(kept)
        found = errors(mapping.error(track.model, self.tracked_reference))
        row: Row = {"failed": track.failed, "failed_at": track.where}
        return row | {f"slam_{name}": number for name, number in found.items()}


def errors(error: mapping.MapError) -> Row:
    """Convert a map's error to mm, with the fraction of the scene that it lacks."""
    return {
        "rmse_mm": 1e3 * error.rmse_m,
        "to_reference_mm": 1e3 * error.to_reference_m,
        "from_reference_mm": 1e3 * error.from_reference_m,
        "uncovered": error.uncovered,
    }


@functools.lru_cache(maxsize=2)
def stage(name: str, data: str | None, frames: int) -> Stage:
    """Open a recording once per process, because opening takes seconds."""
    return Stage(name, data, frames)


# --- tasks -----------------------------------------------------------------------------------------------------------


class Task(NamedTuple):
    """A question about a recording: the map or the track of some frames, or the frames that a policy keeps."""

    kind: Kind
    recording: str
    data: str | None
    frames: int
    about: tuple[int, ...]
    """Frames of a map or track; for the kind "kept", the fade's offset k and the queue size L."""
    policy: str
    trace: Trace
    """The link."""

    @property
    def key(self) -> str:
        """Unique key, independent of the data's folder; maps and tracks depend on their frames alone."""
        run = {"kept": f"{self.policy} {self.trace.name}", "track": f"{WIDTH}", "map": ""}[self.kind]
        text = f"{__version__} {self.kind} {self.recording} {self.frames} {self.about} {run}"
        return hashlib.sha256(text.encode()).hexdigest()[:24]


def carried_out(task: Task) -> tuple[str, Row]:
    """Carry out one task; return its key and result."""
    on = stage(task.recording, task.data, task.frames)
    if task.kind == "kept":
        return task.key, {"kept": on.kept(task.policy, task.trace, *task.about)}
    return task.key, on.mapped(task.about) if task.kind == "map" else on.tracked(task.about)


class Store:
    """Results of tasks by key, held in memory and, if ``path`` is given, in a file with a line per result."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._held: dict[str, Row] = {}
        self._cut = False
        if path is not None and path.exists():
            text = path.read_text(encoding="utf-8")
            self._cut = not text.endswith("\n")
            for line in text.splitlines():
                try:
                    key, row = json.loads(line)
                except ValueError:
                    continue  # a line cut short by a kill
                self._held[key] = row

    def __contains__(self, task: Task) -> bool:
        return task.key in self._held

    def __getitem__(self, task: Task) -> Row:
        return self._held[task.key]

    def add(self, key: str, row: Row) -> None:
        """Keep the result of a task."""
        self._held[key] = row
        if self._path is not None:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a", encoding="utf-8") as file:
                file.write("\n" * self._cut + json.dumps([key, row]) + "\n")
            self._cut = False


def carry_out(tasks: Iterable[Task], store: Store, jobs: int) -> None:
    """Carry out once each task that the store lacks."""
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
