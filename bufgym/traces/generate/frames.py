"""Sizes of compressed RGB-D frames that grow with motion and with detail.

A frame of a scene at rest and of ordinary detail has the base size. Motion adds to it, up to a share of the base that
is reached at a stated speed of the scene: depth noise at edges and rolling shutter leave less to predict from
neighbouring pixels. Detail is how much there is to see: it stays while the camera stands still and is forgotten as the
scene moves on (an AR(1) process over the coordinate, not over time). A little noise is new in each frame.

The base is that of a 640 x 480 RGB-D frame of depth (RVL) and a JPEG of low quality, about 230 kB. The shares are
assumptions (with `drive_motion` they give a coefficient of variation of 0.10 to 0.12); they are not fitted, because
there are no recordings with both sizes and poses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from bufgym.ground.errors import BufgymError
from bufgym.traces.generate.draws import NORMAL_UNIFORMS, nearly_normal, stream
from bufgym.traces.generate.ranges import Between, check_ranges
from bufgym.traces.motion import Motion
from bufgym.traces.trace import US_PER_S, Float64Array, Int64Array


@dataclass(frozen=True)
class FrameModel:
    """How large frames are; shares are parts of the base."""

    base_bytes: Annotated[float, Between(1, 1e9)] = 230_000.0
    """Size of a frame at rest, of ordinary detail."""
    motion_share: Annotated[float, Between(0, 10)] = 0.25
    """What full motion adds."""
    full_motion_per_s: Annotated[float, Between(1e-6, 1e6)] = 0.75
    """Speed of the coordinate, 1/s, from which on motion is full: turning in place at 45 degrees/s."""
    detail_share: Annotated[float, Between(0, 10)] = 0.12
    """Standard deviation of what detail adds or takes away."""
    detail_scale: Annotated[float, Between(1e-6, 1e6)] = 0.5
    """Coordinate over which detail is half forgotten (a correlation of 1 / (1 + step / scale) from frame to frame)."""
    noise_share: Annotated[float, Between(0, 10)] = 0.02
    """Standard deviation of what is new in each frame."""
    least: Annotated[float, Between(0, 1)] = 0.4
    """No frame is smaller than this multiple of the base."""
    most: Annotated[float, Between(1, 100)] = 2.0
    """No frame is larger than this multiple of the base."""

    def __post_init__(self) -> None:
        check_ranges(self)


def frame_sizes(arrival_us: Int64Array, motion: Motion, seed: int, model: FrameModel | None = None) -> Int64Array:
    """Sizes of the frames that arrive at these times: int64[n], bytes, >= 1.

    Args:
        arrival_us: int64[n], microseconds, >= 0, strictly increasing.
        motion: how the camera moves; past its end it begins again.
        seed: >= 0.
        model: by default `FrameModel()`.
    """
    m = FrameModel() if model is None else model
    times = np.asarray(arrival_us)
    if times.ndim != 1 or times.dtype.kind not in "iu" or (np.diff(times) <= 0).any():
        raise BufgymError("arrival_us must be a row of whole microseconds that increase")
    random = stream(seed)
    shocks = nearly_normal(random.random((2 * len(times), NORMAL_UNIFORMS))).reshape(-1, 2)
    if not len(times):
        return np.zeros(0, np.int64)
    moved, speed = _movement(times.astype(np.int64), motion)
    detail = _detail(shocks[:, 0], moved, m.detail_scale)
    relative = 1 + m.motion_share * np.minimum(speed / m.full_motion_per_s, 1)
    relative = relative + m.detail_share * detail + m.noise_share * shocks[:, 1]
    within = np.minimum(np.maximum(relative, m.least), m.most)
    return np.maximum(1, np.rint(m.base_bytes * within)).astype(np.int64)


def _movement(times: Int64Array, motion: Motion) -> tuple[Float64Array, Float64Array]:
    """How far the coordinate moved since the previous frame, and its speed in 1/s; the first frame has the second's."""
    if len(times) < 2:
        return np.zeros(len(times)), np.zeros(len(times))
    moved = np.diff(motion.at(times))
    speed = moved / (np.diff(times) / US_PER_S)
    return np.append(moved[0], moved), np.append(speed[0], speed)


def _detail(shocks: Float64Array, moved: Float64Array, scale: float) -> Float64Array:
    """An AR(1) process of variance 1 that forgets by how far the scene has moved."""
    value, values = 0.0, []
    for k, (shock, step) in enumerate(zip(shocks.tolist(), moved.tolist(), strict=True)):
        memory = 1 / (1 + step / scale) if k else 0.0
        value = memory * value + math.sqrt(1 - memory**2) * shock
        values.append(value)
    return np.array(values)
