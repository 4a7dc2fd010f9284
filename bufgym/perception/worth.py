"""What `bufgym/Mapping-v0` plays and pays: a made-up room is filmed, and the reward is what the frames are worth.

The episode is a recording of a made-up room, always the same one, over a part of a shipped link that differs from
episode to episode. At its end each of these terms says what the frames that arrived are worth, in [0, 1]:

| term | what it is | for |
|---|---|---|
| `covered` | the part of the scene that some frame has seen | a map; the default |
| `followed` | the least part of a frame that the one before it has seen | tracking: a stand-in that takes no time |
| `tracked` | how far tracking gets along the frames, as a part of all | tracking itself: seconds an episode |

To train on tracking take `followed`, to evaluate `tracked`: ``reward={"followed": 1, "tracked": 0}`` reports the second
without counting it.
"""

from __future__ import annotations

import functools
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.errors import BufgymError
from bufgym.observe import reward_term
from bufgym.perception import room, streams, tracking, views
from bufgym.perception.frames import Sequence
from bufgym.perception.mapping import Grid, grid_of
from bufgym.policies.registry import Memory
from bufgym.scenario import Uplink
from bufgym.scenario.draws import shipped
from bufgym.scenario.suites import motion_value
from bufgym.traces.workload import Workload

SEED: Final = 0
FRAMES: Final = 240
"""Of the recording: 8 s."""
SIZES: Final = (
    *(188_078, 188_294, 189_843, 195_316, 199_698, 205_064, 210_528, 215_847, 222_067, 224_835, 224_970, 228_515),
    *(221_105, 219_960, 220_765, 218_843, 216_128, 215_568, 215_483, 216_212, 214_161, 210_834, 207_500, 205_819),
    198_726,
)
"""Bytes of every tenth frame and the last, measured once (a test measures them again): so episodes begin at once, and
are the same whichever JPEG library is installed."""
WIDTH, VIEW_WIDTH = 160, 80
"""Frames are tracked at 160 x 120; how far views overlap is counted at 80 x 60."""
SCALE: Final = 0.25
"""Of the shipped links: then they carry about half of the frames."""


class Scene(NamedTuple):
    """The recording, and what the terms need of it."""

    whole: Sequence
    film: Sequence
    grid: Grid
    seen: NDArray[np.float32]
    coverage: views.Coverage


@functools.cache
def recording() -> Sequence:
    """The made-up room's, not yet filmed."""
    return room.room(SEED, frames=FRAMES)


@functools.cache
def scene() -> Scene:
    """Filmed once a process, in some seconds."""
    whole = recording()
    film = whole.reduced(whole.camera.width // WIDTH).loaded()
    small = film.reduced(WIDTH // VIEW_WIDTH)
    return Scene(whole, film, grid_of(film), views.seen_shares(small), views.Coverage(small))


@functools.cache
def mapping() -> Uplink:
    """The scenario: the recording over the shipped links, begun anywhere."""
    whole = recording()
    x = whole.motion().at(whole.time_us)
    film = Workload("room", whole.time_us, streams.between(SIZES, FRAMES), x=x - x[0])
    return Uplink(traces=shipped()["traces"], workload=film, scale=(SCALE,), value=motion_value())


def coverage_of(frames: NDArray[np.int64]) -> float:
    """The part of the scene that these frames have seen."""
    return scene().coverage.share(frames)


def least_followed(frames: NDArray[np.int64]) -> float:
    """The least part of a frame that the one before it has seen.

    From the recording's first frame to its last: who sends little must not seem to have lost little.
    """
    return views.least_overlap(scene().seen, np.union1d(frames, [0, FRAMES - 1]))


def tracked_part(frames: NDArray[np.int64]) -> float:
    """How far tracking gets along these frames, as a part of the recording."""
    if not len(frames):
        return 0.0
    track = tracking.track(scene().film, frames, scene().grid)
    reached = frames[~np.isnan(track.poses[:, 0, 0])]
    return float(reached[-1] - frames[0]) / (FRAMES - 1)


# --- the same as rewards ---------------------------------------------------------------------------------------------


def _arrived(step: Any) -> NDArray[np.int64]:
    """int64[frames]: those that were transmitted, by their numbers."""
    n = len(step.log)
    if n != FRAMES:
        raise BufgymError(f"episode of {n} messages: this reward term is for bufgym/Mapping-v0, of {FRAMES}")
    return np.flatnonzero(np.asarray(step.log["transmitted_us"]) >= 0)


@reward_term("covered", unit="part of the scene", one_queue=True)
def covered(step: Any, memory: Memory) -> float:
    """at the end, the part of the scene that the frames which arrived have seen (`bufgym/Mapping-v0`)"""
    return coverage_of(_arrived(step)) if step.ended else 0.0


@reward_term("followed", unit="part of a frame", one_queue=True)
def followed(step: Any, memory: Memory) -> float:
    """at the end, the least part of a frame that the one before it has seen: stands in for `tracked`"""
    return least_followed(_arrived(step)) if step.ended else 0.0


@reward_term("tracked", unit="part of the recording", one_queue=True)
def tracked(step: Any, memory: Memory) -> float:
    """at the end, how far tracking gets along the frames that arrived (`bufgym/Mapping-v0`); some seconds"""
    return tracked_part(_arrived(step)) if step.ended else 0.0
