"""Scenario and rewards of `bufgym/Mapping-v0`: a made-up room is filmed, and the reward is the frames' worth.

Every episode sends the same recording of a made-up room over a different part of a shipped link. At its end the terms
`covered`, `followed` and `tracked` rate the frames that arrived, in [0, 1].

Train on `followed` and evaluate with `tracked`: ``reward={"followed": 1, "tracked": 0}`` reports `tracked` without
counting it.
"""

import functools
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from bufgym.model.observe import reward_term
from bufgym.policies.registry import Memory
from bufgym.scenario import Uplink
from bufgym.scenario.draws import shipped
from bufgym.scenario.suites import motion_value
from bufgym.traces.workload import Workload
from bufgym.utils.errors import BufgymError
from bufgym_papers.perception import streams, views
from bufgym_papers.perception.frames import Sequence
from bufgym_papers.perception.room import made_up_room
from bufgym_papers.perception.stage import Stage

SEED: Final = 0
FRAMES: Final = 240  # Frames of the recording, 8 s
SIZES: Final = (
    *(188_078, 188_294, 189_843, 195_316, 199_698, 205_064, 210_528, 215_847, 222_067, 224_835, 224_970, 228_515),
    *(221_105, 219_960, 220_765, 218_843, 216_128, 215_568, 215_483, 216_212, 214_161, 210_834, 207_500, 205_819),
    198_726,
)
"""Bytes of every tenth frame and the last, measured once and checked by a test. So episodes begin at once and do not
depend on the JPEG library installed."""
SCALE: Final = 0.25  # Scale of the shipped links, which then carry about half of the frames


@functools.cache
def recording() -> Sequence:
    return made_up_room(SEED, frames=FRAMES)


@functools.cache
def scene() -> Stage:
    """Render the room once per process, in some seconds, as an environment that rates frames is made."""
    return Stage(recording())


@functools.cache
def mapping() -> Uplink:
    """Make the scenario: the recording over the shipped links from any starting point."""
    whole = recording()
    x = whole.motion().at(whole.time_us)
    film = Workload("room", whole.time_us, streams.between(SIZES, FRAMES), x=x - x[0])
    return Uplink(traces=shipped()["traces"], workload=film, scale=(SCALE,), value=motion_value())


def coverage_of(frames: NDArray[np.int64]) -> float:
    return scene().coverage.share(frames)


def least_followed(frames: NDArray[np.int64]) -> float:
    """Least part of a frame that the one before it has seen.

    It includes the recording's first and last frame, so that sending few frames does not look good.
    """
    return views.least_overlap(scene().seen, np.union1d(frames, [0, FRAMES - 1]))


def tracked_part(frames: NDArray[np.int64]) -> float:
    """Part of the recording up to which tracking along these frames gets."""
    if not len(frames):
        return 0.0
    reached = frames[~np.isnan(scene().track_of(frames.tolist()).poses[:, 0, 0])]
    return float(reached[-1] - frames[0]) / (FRAMES - 1)


def _rated_at_end(name: str, unit: str, rate: Callable[[NDArray[np.int64]], float]) -> Callable[[Any], Any]:
    """Register a term of the frames that arrived, which are rated once an episode has ended."""
    return reward_term(name, unit=unit, one_queue=True, at_end=True, prepare=functools.partial(rate, np.arange(2)))


def _arrived(step: Any) -> NDArray[np.int64]:
    """Indices of the frames transmitted, int64[frames]."""
    n = len(step.log)
    if n != FRAMES:
        raise BufgymError(f"episode of {n} messages: this reward term is for bufgym/Mapping-v0, of {FRAMES}")
    return np.flatnonzero(np.asarray(step.log["transmitted_us"]) >= 0)


@_rated_at_end("covered", "part of the scene", coverage_of)
def covered(step: Any, memory: Memory) -> float:
    """at the end, the part of the scene that the frames which arrived have seen (`bufgym/Mapping-v0`)"""
    return coverage_of(_arrived(step))


@_rated_at_end("followed", "part of a frame", least_followed)
def followed(step: Any, memory: Memory) -> float:
    """at the end, the least part of a frame that the one before it has seen: stands in for `tracked`"""
    return least_followed(_arrived(step))


@_rated_at_end("tracked", "part of the recording", tracked_part)
def tracked(step: Any, memory: Memory) -> float:
    """at the end, how far tracking gets along the frames that arrived in `bufgym/Mapping-v0`; takes some seconds"""
    return tracked_part(_arrived(step))
