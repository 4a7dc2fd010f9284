"""A made-up room, as a robot in it sees it: distances to its walls, and a camera's picture.

Walls are straight and upright, so a ray in the plane says all: how far, on which wall, where along it.
"""

from __future__ import annotations

import io
import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.relay.extra import needs

Floats = NDArray[np.float64]

HALF_M: Final = (6.0, 4.0)
"""The room reaches so far from its middle, along x and y."""
WALL_M: Final = 2.4
EYE_M: Final = 0.9
"""Height of the walls, and of the camera."""
PICTURE: Final = (256, 192)
FIELD_OF_VIEW: Final = math.radians(75)
_BOXES: Final = (  # x, y, width, depth, colour
    (0.0, 0.0, 12.0, 8.0, (214, 206, 190)),  # the room itself
    (0.0, 0.0, 2.8, 1.2, (176, 96, 64)),
    (-5.2, 2.9, 1.2, 1.6, (72, 118, 168)),
    (5.3, -2.8, 1.0, 1.8, (88, 148, 96)),
    (-5.0, -3.4, 1.6, 0.8, (196, 160, 72)),
    (4.6, 3.5, 2.2, 0.7, (148, 92, 148)),
    (0.0, 3.75, 3.0, 0.5, (150, 150, 158)),
)


def _walls() -> tuple[Floats, Floats, Floats]:
    """(where each wall begins [n, 2], where it leads [n, 2], its colour [n, 3])."""
    begins, leads, colours = [], [], []
    for x, y, width, depth, colour in _BOXES:
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (width / 2, depth / 2) + (x, y)
        for k in range(4):
            begins.append(corners[k])
            leads.append(corners[(k + 1) % 4] - corners[k])
            colours.append(np.array(colour) * (1.0 if k % 2 else 0.8))  # light comes from one side
    return np.array(begins), np.array(leads), np.array(colours)


_BEGINS, _LEADS, _COLOURS = _walls()


class Pose(NamedTuple):
    """Where a robot stands, m, and where it looks, rad."""

    x: float
    y: float
    yaw: float


def pose_at(number: int, time_s: float) -> Pose:
    """Robot ``number`` drives round the table in the middle, on a loop of its own; odd ones the other way."""
    loop_x, loop_y = 3.0 + 0.45 * (number % 3), 1.75 + 0.3 * (number % 3)
    way = 1 if number % 2 == 0 else -1
    angle = way * time_s * (0.22 + 0.02 * (number % 4)) + 2.1 * number
    x, y = loop_x * math.cos(angle), loop_y * math.sin(angle)
    return Pose(x, y, math.atan2(way * loop_y * math.cos(angle), -way * loop_x * math.sin(angle)))


def cast(pose: Pose, angles: Floats) -> tuple[Floats, NDArray[np.int64], Floats]:
    """(distance in m, number of the wall, m along it) for a ray at each of ``angles``, from where the robot looks."""
    ahead = np.stack([np.cos(angles + pose.yaw), np.sin(angles + pose.yaw)], -1)[:, None]
    away = _BEGINS - (pose.x, pose.y)
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray along a wall meets it nowhere
        slant = _cross(ahead, _LEADS)
        distance = _cross(away, _LEADS) / slant
        along = _cross(away, ahead) / slant
        meets = (distance > 1e-6) & (along >= 0) & (along <= 1)
    distance = np.where(meets, distance, np.inf)
    wall = distance.argmin(1)
    rays = np.arange(len(angles))
    return distance[rays, wall], wall, along[rays, wall] * np.hypot(*_LEADS[wall].T)


def _cross(one: Any, other: Any) -> Any:
    return one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]


_FOCAL: Final = PICTURE[0] / 2 / math.tan(FIELD_OF_VIEW / 2)
_ANGLES: Final = np.arctan((PICTURE[0] / 2 - 0.5 - np.arange(PICTURE[0])) / _FOCAL)
_BELOW: Final = ((np.arange(PICTURE[1]) + 0.5 - PICTURE[1] / 2) / _FOCAL).astype(np.float32)[:, None]
"""Of a row's point 1 m ahead, m under the eye."""
_HALF: Final = PICTURE[1] // 2
_REACH: Final = EYE_M / _BELOW[_HALF:]
"""How far ahead the floor is in each row of the lower half, m."""
_CEILING: Final = (236 - 60 * np.exp(_BELOW[:_HALF] * 4)).astype(np.uint8)[..., None]
_TILES: Final = (np.array([96, 122]) / (1 + 0.06 * _REACH))[..., None] * np.array([1.05, 1.0, 0.92])
"""Colours of the floor's dark and light tiles in each row."""


def picture(pose: Pose) -> NDArray[np.uint8]:
    """What the camera sees, [height, width, 3]."""
    distance, wall, along = cast(pose, _ANGLES)
    depth = (distance * np.cos(_ANGLES)).astype(np.float32)
    # Panels of half a metre, darker with distance.
    panel = 1 - 0.12 * (np.floor(along * 2) % 2) - 0.25 * (np.abs(along * 2 % 1 - 0.5) > 0.47)
    shade = (_COLOURS[wall] * (panel / (1 + 0.11 * depth))[:, None]).astype(np.uint8)
    frame = np.empty((PICTURE[1], PICTURE[0], 3), np.uint8)
    frame[:] = shade
    down = _BELOW * depth
    upper, lower = frame[:_HALF], frame[_HALF:]
    np.copyto(upper, _CEILING, where=(down[:_HALF] < EYE_M - WALL_M)[..., None])
    np.copyto(lower, (shade * 0.55).astype(np.uint8), where=(down[_HALF:] > EYE_M - 0.12)[..., None])  # skirting
    turn = _ANGLES + pose.yaw
    aside, ahead = ((f(turn) / np.cos(_ANGLES)).astype(np.float32) for f in (np.sin, np.cos))
    tile = np.floor(pose.x + _REACH * ahead).astype(np.int32) + np.floor(pose.y + _REACH * aside).astype(np.int32)
    floor = _TILES.astype(np.uint8)[np.arange(_HALF)[:, None], tile & 1]
    np.copyto(lower, floor, where=(down[_HALF:] > EYE_M)[..., None])
    return frame


def jpeg(frame: NDArray[np.uint8], quality: int = 70) -> bytes:
    """The picture as a JPEG file."""
    with needs("PIL"):
        from PIL import Image
    file = io.BytesIO()
    Image.fromarray(frame).save(file, "JPEG", quality=quality)
    return file.getvalue()
