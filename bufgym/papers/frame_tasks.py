"""Tasks on frames: find which frames of a recording arrive, and build their map and their track.

A folder keeps each task's result by the task's inputs alone. So figures share their runs, equal runs are played once,
and a killed run resumes where it stopped.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from bufgym import __version__
from bufgym.benchmark import cluster
from bufgym.benchmark.run import bar
from bufgym.ground.errors import BufgymError
from bufgym.papers.extra import library
from bufgym.papers.perception import frames as depth_frames
from bufgym.papers.perception import mapping, orb, streams, tracking, views
from bufgym.papers.perception.recordings import open_sequence
from bufgym.papers.perception.room import made_up_room
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
Kind = Literal["kept", "map", "track"]


# --- one recording ---------------------------------------------------------------------------------------------------


class Stage:
    """A recording reduced to ``WIDTH``, with everything that runs on it share."""

    def __init__(self, name: str, data: str | None, frames: int) -> None:
        if name == "room":
            whole_size: depth_frames.Sequence = made_up_room(0, frames=frames)
        elif data is None:
            raise BufgymError(f"recording {name}: needs a folder of recordings (--data DIR) with {SEVEN_SCENES}")
        else:
            whole_size = open_sequence(Path(data) / SEVEN_SCENES)
        self.whole = whole_size.first(frames)
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
        return errors(mapping.map_error(self.map_of(kept), self.reference))

    def tracked(self, kept: Sequence[int]) -> Row:
        """Track along these frames; report where tracking breaks and the error of its map until then. The reference is
        the tracked map of all frames: both maps drift alike, so they differ by the missing frames."""
        track = self.track_of(kept)
        found = errors(mapping.map_error(track.model, self.tracked_reference))
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
    frames: int
    about: tuple[str | int, ...]
    """Frames of a map or track; for the kind "kept" the policy, the link's name, the fade's offset k and L."""


def carried_out(version: str, task: Task, data: str | None, link: Trace) -> tuple[Task, Row]:
    """Carry out one task; return it and its result."""
    on, about = stage(task.recording, data, task.frames), cast(Any, task.about)
    if task.kind == "kept":
        policy, _, k, L = about
        return task, {"kept": on.kept(policy, link, k, L)}
    return task, on.mapped(about) if task.kind == "map" else on.tracked(about)


def carry_out(tasks: Iterable[Task], data: str | None, link: Trace, store: Path | None, jobs: int) -> dict[Task, Row]:
    """Carry out each task once, in ``jobs`` processes; the folder ``store`` keeps results for later calls."""
    remembered = library("joblib", "bench").Memory(store, verbose=0).cache(carried_out, ignore=["data", "link"])
    calls = [(f"{__version__} {WIDTH}", task, data, link) for task in dict.fromkeys(tasks)]
    known = [remembered.check_call_in_cache(*call) for call in calls]
    found = dict(remembered(*call) for call in itertools.compress(calls, known))
    missing = [call for call, is_known in zip(calls, known, strict=True) if not is_known]
    with bar(len(missing), show=True, unit="run") as advance:
        alone = (remembered(*call) for call in missing)
        spread = cluster.spread(((remembered, call) for call in missing), len(missing), jobs, "loky", None)
        for task, row in alone if jobs == 1 or not missing else spread:
            found[task] = row
            advance(1)
    return found
