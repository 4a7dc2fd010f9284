"""Where a camera or a robot was: poses over time, and their geometry.

Between two poses the position moves along a line and the orientation along the shortest arc (slerp; K. Shoemake,
"Animating Rotation with Quaternion Curves", SIGGRAPH 1985).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from bufgym.traces.trace import US_PER_S, Float64Array, Int64Array

_PIECE: Final = 2**17  # Poses that are worked on at once: a day of them would need several times their memory


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses over time; times increase from 0."""

    time_us: Int64Array
    """int64[n], n >= 2, microseconds."""
    position_m: Float64Array
    """float64[n, 3]."""
    quaternion: Float64Array
    """float64[n, 4], unit; any order of the four, q and -q being the same orientation."""
    format: str = ""
    """What they were read from."""
    start_us: int = 0
    """Time 0 by the recording's clock, microseconds."""

    def path_m(self) -> float:
        """Length of the way from pose to pose, m."""
        steps = (np.linalg.norm(np.diff(piece.position_m, axis=0), axis=1).sum() for piece in self.pieces())
        return float(sum(steps))

    def at(self, time_us: Int64Array) -> Poses:
        """The poses at these times, int64[m] within the recording: position linear, orientation by slerp."""
        k = np.clip(np.searchsorted(self.time_us, time_us, side="right") - 1, 0, self.time_us.size - 2)
        share = ((time_us - self.time_us[k]) / (self.time_us[k + 1] - self.time_us[k]))[:, None]
        position = self.position_m[k] + share * (self.position_m[k + 1] - self.position_m[k])
        return Poses(time_us, position, slerp(self.quaternion[k], self.quaternion[k + 1], share), self.format)

    def resampled(self, rate_hz: float) -> Poses:
        """The poses at multiples of 1 / `rate_hz` and at the end; quaternions need not be exactly of norm 1."""
        end_us = self.time_us[-1]
        grid_us = np.rint(np.arange(int(end_us * rate_hz / US_PER_S) + 1) * (US_PER_S / rate_hz)).astype(np.int64)
        grid_us = np.append(grid_us[grid_us < end_us], end_us)
        parts = [self._around(part).at(part) for part in np.split(grid_us, range(_PIECE, len(grid_us), _PIECE))]
        position_m, quaternion = (
            np.concatenate(arrays) for arrays in zip(*((p.position_m, p.quaternion) for p in parts), strict=True)
        )
        return Poses(grid_us, position_m, quaternion, self.format)

    def _around(self, time_us: Int64Array) -> Poses:
        """The poses between which all of ``time_us``, int64[m] rising, lie; their quaternions have norm 1."""
        start = min(int(np.searchsorted(self.time_us, time_us[0], side="right")) - 1, self.time_us.size - 2)
        end = int(np.searchsorted(self.time_us, time_us[-1], side="right")) + 1
        part = slice(start, end)
        return Poses(self.time_us[part], self.position_m[part], unit(self.quaternion[part]), self.format)

    def pieces(self) -> Iterator[Poses]:
        """The poses in pieces that each begin with the last pose of the one before, so that work on one is small."""
        for start in range(0, max(self.time_us.size - 1, 1), _PIECE):
            part = slice(start, start + _PIECE + 1)
            yield Poses(self.time_us[part], self.position_m[part], self.quaternion[part], self.format)


def gaps_between(time_us: Int64Array, max_gap_s: float) -> tuple[tuple[int, int], ...]:
    """(start, end) of each pair of neighbours in int64[n] that are more than `max_gap_s` apart, microseconds."""
    wide = np.flatnonzero(np.diff(time_us) > max_gap_s * US_PER_S)
    return tuple((int(time_us[k]), int(time_us[k + 1])) for k in wide)


def longest_s(gaps: tuple[tuple[int, int], ...]) -> float:
    """Length of the longest of these stretches, (start, end) in microseconds, in s; 0 if there is none."""
    return max((end - start for start, end in gaps), default=0) / US_PER_S


def slerp(start: Float64Array, end: Float64Array, share: Float64Array) -> Float64Array:
    """Unit quaternions on the shortest arc from start to end, each float64[m, 4]; share is float64[m, 1]."""
    end = _same_side(start, end)
    half = 2 * _half_angle(start, end)[:, None]
    sine = np.sin(half)
    near = sine < 1e-9  # so close that arc and chord are one
    safe = np.where(near, 1.0, sine)
    mixed = np.where(
        near,
        (1 - share) * start + share * end,
        (np.sin((1 - share) * half) * start + np.sin(share * half) * end) / safe,
    )
    return unit(mixed)


def angles(a: Float64Array, b: Float64Array) -> Float64Array:
    """Rotation angle in rad, 0..pi, between unit quaternions float64[m, 4].

    By the half-angle's tangent: an arc cosine would lose the small angles between neighbouring poses.
    """
    return np.asarray(2 * (2 * _half_angle(a, _same_side(a, b))), dtype=np.float64)


def unit(quaternion: Float64Array) -> Float64Array:
    """The rows of float64[m, 4], each divided by its norm."""
    return np.asarray(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True), dtype=np.float64)


def normalize(quaternion: Float64Array) -> None:
    """As ``unit``, in place."""
    for start in range(0, len(quaternion), _PIECE):
        quaternion[start : start + _PIECE] = unit(quaternion[start : start + _PIECE])


def quaternions(rotation: Float64Array) -> Float64Array:
    """Unit quaternions (x, y, z, w), float64[m, 4], of rotation matrices float64[m, 3, 3].

    Each is computed from the largest of its four components, which is at least 0.5, so that nothing is divided by a
    small number (S. W. Shepperd, "Quaternion from Rotation Matrix", J. Guidance and Control 1978).
    """
    r = rotation
    trace = r[:, 0, 0] + r[:, 1, 1] + r[:, 2, 2]
    # Row i of each symmetric matrix is 4 q_i (x, y, z, w).
    rows = np.empty((len(r), 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        rows[:, i, i] = 1 + 2 * r[:, i, i] - trace
        rows[:, i, j] = rows[:, j, i] = r[:, i, j] + r[:, j, i]
        rows[:, i, 3] = rows[:, 3, i] = r[:, k, j] - r[:, j, k]
    rows[:, 3, 3] = 1 + trace
    largest = np.argmax(np.diagonal(rows, axis1=1, axis2=2), axis=1)
    return unit(rows[np.arange(len(r)), largest])


def rotations(quaternion: Float64Array) -> Float64Array:
    """Rotation matrices, float64[m, 3, 3], of unit quaternions (x, y, z, w), float64[m, 4]."""
    vector, w = quaternion[:, :3], quaternion[:, 3]
    cross = np.zeros((len(quaternion), 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        cross[:, i, j], cross[:, j, i] = -vector[:, k], vector[:, k]
    # Rodrigues: 1 + 2 w [v] + 2 [v]^2.
    return np.asarray(np.eye(3) + 2 * w[:, None, None] * cross + 2 * cross @ cross, np.float64)


def product(a: Float64Array, b: Float64Array) -> Float64Array:
    """First turned by b, then by a: products of quaternions (x, y, z, w), each float64[m, 4]."""
    vector = a[:, 3:] * b[:, :3] + b[:, 3:] * a[:, :3] + np.cross(a[:, :3], b[:, :3])
    return np.column_stack([vector, a[:, 3] * b[:, 3] - np.sum(a[:, :3] * b[:, :3], axis=1)])


def _same_side(a: Float64Array, b: Float64Array) -> Float64Array:
    """b or -b, whichever is nearer to a: they are the same orientation."""
    return np.where(np.sum(a * b, axis=1, keepdims=True) < 0, -b, b)


def _half_angle(a: Float64Array, b: Float64Array) -> Float64Array:
    """Half the angle in rad between the vectors a and b, float64[m, 4] of norm 1, as float64[m]."""
    return np.asarray(np.arctan2(np.linalg.norm(b - a, axis=1), np.linalg.norm(b + a, axis=1)), np.float64)
