"""Tasks on frames: find which frames of a recording arrive, and build their map and their track.

A folder keeps each task's result by the task's inputs alone. So figures share their runs, equal runs are played once,
and a killed run resumes where it stopped.
"""

import functools
import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal, NamedTuple, cast

from bufgym.benchmark import cluster
from bufgym.benchmark.rows import Row
from bufgym.traces import Trace
from bufgym.utils import __version__
from bufgym.utils.errors import BufgymError
from bufgym.utils.libraries import library
from bufgym.utils.progress import bar
from bufgym_papers.perception.recordings import open_sequence
from bufgym_papers.perception.room import made_up_room
from bufgym_papers.perception.stage import WIDTH, Stage

FOLDERS = {"7-scenes": "rgbd_7scenes", "tum": "rgbd_dataset_freiburg1_desk"}
"""Recording -> its folder in that of all recordings; the paper's own are of TUM RGB-D."""
Kind = Literal["kept", "map", "track"]


@functools.lru_cache(maxsize=2)
def stage(name: str, data: str | None, frames: int) -> Stage:
    """Open a recording once per process, because opening takes seconds."""
    if name == "room":
        return Stage(made_up_room(0, frames=frames))
    if data is None:
        raise BufgymError(f"recording {name}: needs a folder of recordings (--data DIR) with {FOLDERS[name]}")
    return Stage(open_sequence(Path(data) / FOLDERS[name]).first(frames))


class FrameTask(NamedTuple):
    """A question about a recording: the map or the track of some frames, or the frames that a policy keeps."""

    kind: Kind
    recording: str
    frames: int
    about: tuple[str | int, ...]
    """Frames of a map or track; for the kind "kept" the policy, the link's name, the fade's offset k and L."""


def carried_out(version: str, task: FrameTask, data: str | None, link: Trace) -> tuple[FrameTask, Row]:
    """Carry out one task; return it and its result."""
    on, about = stage(task.recording, data, task.frames), cast(Any, task.about)
    if task.kind == "kept":
        policy, _, k, L = about
        return task, {"kept": on.kept(policy, link, k, L)}
    return task, on.mapped(about) if task.kind == "map" else on.tracked(about)


def carry_out(
    tasks: Iterable[FrameTask], data: str | None, link: Trace, store: Path | None, jobs: int
) -> dict[FrameTask, Row]:
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
