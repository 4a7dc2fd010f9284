"""Depth camera in a made-up room: finds the box or ball that each pixel sees and a Kinect's measurement of it.

A Kinect finds disparities in steps of 1/8 pixel by matching windows against the dots of a projector beside it [K.
Khoshelham, S. Elberink, "Accuracy and Resolution of Kinect Depth Data for Indoor Mapping Applications", Sensors 2012].
So its depth has steps that grow with the square of the depth, and neighbours share their errors. Places at the edges of
things that the projector does not reach are missing. Noise is a stateless hash of seed, frame and place.
"""

import itertools
import math
from typing import Any

import numpy as np

from bufgym.jit import kernel
from bufgym.traces.trace import Float64Array as Array

BASELINE_M = 0.075  # Distance from the camera to the projector along x, m
STEPS_PER_PIXEL = 8.0  # Steps of the disparity
NOISE_STEPS = 0.5  # Standard deviation of the disparity, in such steps
WINDOW = 5  # Pixels that are matched together, and share their error
NEAREST_M, FARTHEST_M = 0.4, 5.0  # What can be measured, m
GRAZING = 0.12  # Cosine of the angle to the surface's normal below which the dots are too stretched
SLACK = 1e-3  # Margin around the bounds of things, in pixels and m, so that rounding hides none

ANYWHERE = (-math.inf, math.inf, -math.inf, math.inf, -math.inf)  # Bounds of a thing that may be seen in every pixel

_MASK = 0xFFFFFFFF


@kernel
def _mixed(state: int, value: int) -> int:
    """A hash of 32 bits; products stay below 2**63."""
    state = ((state ^ (value & _MASK)) * 0x45D9F3B) & _MASK
    state = ((state ^ (state >> 16)) * 0x45D9F3B) & _MASK
    return state ^ (state >> 15)


@kernel
def _uniform(seed: int, a: int, b: int, c: int) -> float:
    """A number from 0 to 1 for each (seed, a, b, c)."""
    return _mixed(_mixed(_mixed(_mixed(0x2545F491, seed), a), b), c) / 4294967296.0


@kernel
def _hit(box: Any, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, face: Any) -> float:
    """Distance along the ray at which it enters a turned box, or leaves it if it starts inside; -1 without a hit.

    box: float64[8] = centre, half sizes, cosine and sine of its turn about z. ``face`` float64[3]: the normal, written.
    """
    c, s = box[6], box[7]
    px, py, pz = ox - box[0], oy - box[1], oz - box[2]
    px, py = c * px + s * py, c * py - s * px
    ex, ey = c * dx + s * dy, c * dy - s * dx
    near, far, near_axis, far_axis = -math.inf, math.inf, 0, 0
    for axis in range(3):
        p = px if axis == 0 else (py if axis == 1 else pz)
        e = ex if axis == 0 else (ey if axis == 1 else dz)
        h = box[3 + axis]
        if e == 0.0:
            if abs(p) > h:
                return -1.0
            continue
        a, b = (-h - p) / e, (h - p) / e
        if a > b:
            a, b = b, a
        if a > near:
            near, near_axis = a, axis
        if b < far:
            far, far_axis = b, axis
    if near > far or far <= 0.0:
        return -1.0
    axis = near_axis if near > 0.0 else far_axis
    e = ex if axis == 0 else (ey if axis == 1 else dz)
    sign = -1.0 if e > 0.0 else 1.0
    face[0] = sign * (c if axis == 0 else (-s if axis == 1 else 0.0))
    face[1] = sign * (s if axis == 0 else (c if axis == 1 else 0.0))
    face[2] = sign if axis == 2 else 0.0
    return near if near > 0.0 else far


@kernel
def _hit_ball(ball: Any, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, face: Any) -> float:
    """Do the same for a ball, float64[8] = centre, radius and zeros."""
    px, py, pz = ox - ball[0], oy - ball[1], oz - ball[2]
    a = dx * dx + dy * dy + dz * dz
    b = px * dx + py * dy + pz * dz
    c = px * px + py * py + pz * pz - ball[3] * ball[3]
    root = b * b - a * c
    if root <= 0.0:
        return -1.0
    t = (-b - math.sqrt(root)) / a
    face[0], face[1], face[2] = (px + t * dx) / ball[3], (py + t * dy) / ball[3], (pz + t * dz) / ball[3]
    return float(t)


def bounds(things: Array, balls: int, lens: Array, to_camera: Array, aside_m: float) -> Array:
    """Find the range of columns and rows of each thing, and its least depth, float64[n, 5].

    The eye is ``aside_m`` right of the camera and looks in the same direction. A box is bounded by its corners and a
    ball by the corners of a cube. A thing that reaches behind the eye, as the room does, may be anywhere; one that is
    behind it altogether is nowhere.
    """
    half, turn = things[:, 3:6].copy(), things[:, 6:8].copy()
    half[balls:], turn[balls:] = things[balls:, 3:4], (1.0, 0.0)
    a, b, up = np.moveaxis(half[:, None] * list(itertools.product((-1, 1), repeat=3)), 2, 0)
    c, s = turn.T[:, :, None]
    world = things[:, None, :3] + np.stack([c * a - s * b, s * a + c * b, up], axis=2)
    x, y, z = np.moveaxis(world @ to_camera[:3, :3].T + to_camera[:3, 3], 2, 0)
    with np.errstate(all="ignore"):
        u, v = lens[0] * (x - aside_m) / z + lens[2], lens[1] * y / z + lens[3]
    ranges = [u.min(axis=1) - SLACK, u.max(axis=1) + SLACK, v.min(axis=1) - SLACK, v.max(axis=1) + SLACK]
    found = np.stack([*ranges, z.min(axis=1) - SLACK], axis=1)
    found[z.min(axis=1) <= SLACK] = ANYWHERE
    found[z.max(axis=1) < -SLACK, 1] = -np.inf
    return np.ascontiguousarray(found)


@kernel
def _within(bounds: Any, i: int, u: float, v: float, z: float) -> bool:
    """Whether thing ``i`` may be seen at this column and row, up to this depth."""
    columns = bounds[i, 0] <= u <= bounds[i, 1]
    return bool(columns and bounds[i, 2] <= v <= bounds[i, 3] and bounds[i, 4] <= z)


@kernel
def render(
    things: Any,
    balls: int,
    bounds: Any,
    lens: Any,
    stride: int,
    to_world: Any,
    seed: int,
    frame: int,
    noisy: bool,
    face: Any,
    depth: Any,
    grey: Any,
) -> None:
    """Render every ``stride``-th pixel of every ``stride``-th row of a frame.

    Args:
        things: float64[n, 8], boxes and from number ``balls`` on balls; the first box is the room, seen from inside.
        bounds: float64[2, n, 5], their bounds for the camera and for the projector, from `bounds`.
        lens: lens of the whole camera.
        to_world: float64[4, 4], camera to world.
        noisy: measure as a Kinect does; otherwise the true depth of every pixel.
        face: float64[6], scratch.
        depth: float32[height, width], written, m, 0 = nothing measured.
        grey: uint8[height, width], written.
    """
    m = to_world
    ox, oy, oz = m[0, 3], m[1, 3], m[2, 3]
    lx, ly, lz = ox + BASELINE_M * m[0, 0], oy + BASELINE_M * m[1, 0], oz + BASELINE_M * m[2, 0]
    for row in range(depth.shape[0]):
        for column in range(depth.shape[1]):
            v, u = row * stride, column * stride
            a, b = (u - lens[2]) / lens[0], (v - lens[3]) / lens[1]
            dx = m[0, 0] * a + m[0, 1] * b + m[0, 2]
            dy = m[1, 0] * a + m[1, 1] * b + m[1, 2]
            dz = m[2, 0] * a + m[2, 1] * b + m[2, 2]
            z, thing = math.inf, 0
            for n in range(things.shape[0]):
                if not _within(bounds[0], n, u, v, z):
                    continue
                hit = _distance(things, balls, n, ox, oy, oz, dx, dy, dz, face)
                if 0.0 < hit < z:
                    z, thing = hit, n
                    face[3], face[4], face[5] = face[0], face[1], face[2]
            x, y, w = ox + z * dx, oy + z * dy, oz + z * dz
            nx, ny, nz = face[3], face[4], face[5]
            grey[row, column] = _shade(x, y, w, nx, ny, nz, seed, thing)
            if not noisy:
                depth[row, column] = z
                continue
            depth[row, column] = 0.0
            if z < NEAREST_M or z > FARTHEST_M:
                continue
            if -(nx * dx + ny * dy + nz * dz) < GRAZING * math.sqrt(dx * dx + dy * dy + dz * dz):
                continue
            # Does the projector reach the place? The ray from it has length 1 at the place.
            lit, lit_u = True, u - lens[0] * BASELINE_M / z
            for n in range(1, things.shape[0]):
                if not _within(bounds[1], n, lit_u, v, z):
                    continue
                hit = _distance(things, balls, n, lx, ly, lz, x - lx, y - ly, w - lz, face)
                if 0.0 < hit < 0.995:
                    lit = False
                    break
            if not lit:
                continue
            noise = -2.0  # the sum of four uniform numbers has mean 2 and variance 1/3
            for i in range(4):
                noise += _uniform(seed, 4 * frame + i, u // WINDOW, v // WINDOW)
            scale = lens[0] * BASELINE_M * STEPS_PER_PIXEL
            steps = math.floor(scale / z + NOISE_STEPS * math.sqrt(3.0) * noise + 0.5)
            depth[row, column] = math.floor(1000.0 * scale / steps + 0.5) / 1000.0  # whole mm


@kernel
def _distance(
    things: Any, balls: int, n: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, face: Any
) -> float:
    if n >= balls:
        return _hit_ball(things[n], ox, oy, oz, dx, dy, dz, face)
    return _hit(things[n], ox, oy, oz, dx, dy, dz, face)


@kernel
def _shade(x: float, y: float, z: float, nx: float, ny: float, nz: float, seed: int, thing: int) -> int:
    """Grey of a place: a colour for each thing, tiles of three sizes cut from space, and light from above."""
    # A little below the surface, so that a wall does not lie on the border between two tiles.
    x, y, z = x - 0.003 * nx, y - 0.003 * ny, z - 0.003 * nz
    value = 0.35 * _uniform(seed, -1, thing, 0)
    tile_m = 0.32
    for octave in range(3):
        i, j, k = math.floor(x / tile_m), math.floor(y / tile_m), math.floor(z / tile_m)
        value += 0.2 * _uniform(seed + octave + 1, i, j, k)
        tile_m /= 2.7
    light = 0.75 + 0.2 * nz + 0.1 * nx - 0.05 * ny
    return int(255.0 * min(1.0, value * light + 0.05))
