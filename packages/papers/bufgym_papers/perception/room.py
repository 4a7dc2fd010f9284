"""Made-up room in place of a recording: walls, furniture and texture, seen by a moving Kinect.

Everything is drawn from a seed beforehand. Each frame is ray-cast on demand, so a reduced frame costs only its own
pixels.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from bufgym.traces.generate.draws import stream
from bufgym.traces.motion import MotionSettings, motion_from_poses
from bufgym.traces.poses import Poses, quaternions
from bufgym.traces.shipped import load_motion
from bufgym.traces.trace import US_PER_S, Float64Array, Int64Array
from bufgym.utils.errors import BufgymError
from bufgym_papers.perception import rays
from bufgym_papers.perception.frames import Depth, Image, Sequence, encoded_bytes
from bufgym_papers.perception.recordings import SEVEN_SCENES_CAMERA, SEVEN_SCENES_HZ, matrices

SIZE_M: Final = (5.0, 4.2, 2.6)  # Length, width and height of the room, m
EYE_M: Final = 1.3  # Mean height of the camera, m
FREE_M: Final = 0.45  # Least distance of things from the camera's path, m
BOXES: Final = 80
BALLS: Final = 8
MOTION: Final = "drive-0"  # Shipped recording whose motion the camera follows
PACE: Final = 0.5  # Its speed. The view then changes as fast as in 7-Scenes, 11.6 fields of view in 1000 frames.

_LAP_POINTS: Final = 4000
_TRIES: Final = 60


@dataclass(frozen=True, eq=False)
class Furniture:
    """Walls and furniture of a room. The floor is z = 0 and one corner is the origin."""

    things: Float64Array
    """Boxes, then balls, float64[n, 8]. A box has centre, half sizes, cosine and sine of its turn about z; the first is
    the room itself. A ball has centre, radius and zeros."""
    balls: int  # index of the first ball


class MadeUpRoom(Sequence):
    """The recording of a made-up room."""

    def __init__(
        self, name: str, scene: Furniture, time_us: Int64Array, poses: Float64Array, seed: int, stride: int = 1
    ) -> None:
        """``seed`` is of noise and texture; every ``stride``-th pixel of every ``stride``-th row is rendered."""
        self.name, self.scene, self.time_us, self.poses = name, scene, time_us, poses
        self.camera = SEVEN_SCENES_CAMERA.every(stride)
        self._seed, self._stride = seed, stride

    def depth(self, k: int) -> Depth:
        return self.rendered(k)[0]

    def image(self, k: int) -> Image:
        return self.rendered(k)[1]

    def rendered(self, k: int, noisy: bool = True) -> tuple[Depth, Image]:
        """Depth and picture of frame k; without ``noisy`` the depth is true, with no gaps."""
        if not 0 <= k < len(self):
            raise BufgymError(f"frame {k}: must be from 0 to {len(self) - 1}")
        shape = (self.camera.height, self.camera.width)
        depth, grey = np.empty(shape, np.float32), np.empty(shape, np.uint8)
        whole, scene, pose = SEVEN_SCENES_CAMERA, self.scene, self.poses[k]
        things, lens, to_camera = (scene.things, scene.balls), whole.lens, np.linalg.inv(pose)
        bounds = np.stack([rays.bounds(*things, lens, to_camera, aside_m) for aside_m in (0.0, rays.BASELINE_M)])
        rays.render(*things, bounds, lens, self._stride, pose, self._seed, k, noisy, np.empty(6), depth, grey)
        return depth, grey

    def reduced(self, stride: int) -> Sequence:
        self.camera.every(stride)  # checks it
        return MadeUpRoom(self.name, self.scene, self.time_us, self.poses, self._seed, self._stride * stride)

    def size_bytes(self, k: int) -> int:
        whole = MadeUpRoom(self.name, self.scene, self.time_us, self.poses, self._seed)
        return encoded_bytes(*whole.rendered(k))


def made_up_room(seed: int, *, frames: int = 794) -> MadeUpRoom:
    """Make a recording of a made-up room, 640x480, 30 frames a second; by default as long as AFR's."""
    if frames < 2:
        raise BufgymError(f"frames = {frames}: must be at least 2")
    rng = stream(seed)
    time_us = np.rint(np.arange(frames) * (US_PER_S / SEVEN_SCENES_HZ)).astype(np.int64)
    poses = _walk(time_us)
    return MadeUpRoom(f"room-{seed}", furnished(rng, poses[:, :3, 3]), time_us, poses, seed)


def _walk(time_us: Int64Array) -> Float64Array:
    """Poses on a closed path through the room, looking at its walls, float64[n, 4, 4]."""
    phase = np.linspace(0, 2 * np.pi, _LAP_POINTS + 1)
    size_m, centre = np.array(SIZE_M), np.array(SIZE_M) / 2
    place = np.stack(
        [
            centre[0] + (size_m[0] / 2 - 1.7) * np.cos(phase),
            centre[1] + (size_m[1] / 2 - 1.5) * np.sin(phase),
            EYE_M + 0.15 * np.sin(3 * phase),
        ],
        axis=1,
    )
    # It looks outwards but sways, so that it returns to places just seen.
    yaw, pitch = phase + 0.5 * np.sin(4 * phase), np.radians(-12.0 + 9.0 * np.sin(3 * phase))
    lap = np.tile(np.eye(4), (len(phase), 1, 1))
    ahead = np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], axis=1)
    right = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], axis=1)
    lap[:, :3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=2)
    lap[:, :3, 3] = place
    settings = MotionSettings(fov_deg=SEVEN_SCENES_CAMERA.fov_deg, rate_hz=1e6)
    way = motion_from_poses(
        Poses(np.arange(len(phase), dtype=np.int64), place, quaternions(lap[:, :3, :3])), settings
    ).coordinate
    gone = np.mod(load_motion(MOTION).at(time_us) * PACE, way[-1])
    nearest = np.interp(gone, way, np.arange(len(way)))
    at = Poses(np.arange(len(way), dtype=np.int64) * US_PER_S, place, quaternions(lap[:, :3, :3]))
    return matrices(at.at(np.rint(nearest * US_PER_S).astype(np.int64)))


def furnished(rng: np.random.Generator, way: Float64Array) -> Furniture:
    """Draw furniture along walls and on the floor, and pictures and balls above; ``way`` float64[n, 3] stays free."""
    size_m = np.array(SIZE_M)
    boxes = [np.array([*size_m / 2, *size_m / 2, 1.0, 0.0])]
    balls: list[Float64Array] = []
    for n in range(BOXES + BALLS):
        for _ in range(_TRIES):
            ball = n >= BOXES
            thing = _ball(rng, size_m) if ball else _box(rng, size_m, n)
            reach = thing[3] if ball else np.linalg.norm(thing[3:5])
            near = np.linalg.norm(way[:, :2] - thing[:2], axis=1) < reach + FREE_M
            near &= np.abs(way[:, 2] - thing[2]) < thing[3 if ball else 5] + FREE_M
            if not near.any():
                (balls if ball else boxes).append(thing)
                break
    return Furniture(np.array(boxes + balls), len(boxes))


def _box(rng: np.random.Generator, size_m: Float64Array, n: int) -> Float64Array:
    """Draw box ``n``. In each group of four, one stands at a wall, one on the floor, and two hang at a wall."""
    half = np.array([0.15 + 0.4 * rng.random(), 0.12 + 0.2 * rng.random(), 0.2 + 0.75 * rng.random()])
    turn = 0.5 * np.pi * int(rng.integers(4))
    if n % 4 == 1:
        half[2] *= 0.45
        turn = 2 * np.pi * rng.random()
        centre = np.array([*(0.3 + rng.random(2) * (size_m[:2] - 0.6)), half[2]])
    else:
        along = rng.random(2) * size_m[:2]
        wall = rng.integers(4)
        reach = half[0] if round(turn / (0.5 * np.pi)) % 2 == wall // 2 else half[1]
        along[wall // 2] = reach if wall % 2 else size_m[wall // 2] - reach
        centre = np.array([*along, half[2]])
        if n % 4 > 1:
            half[2] *= 0.35
            centre[2] = 0.6 + 1.5 * rng.random()
    return np.array([*centre, *half, np.cos(turn), np.sin(turn)])


def _ball(rng: np.random.Generator, size_m: Float64Array) -> Float64Array:
    centre = np.array([*(rng.random(2) * size_m[:2]), 0.3 + 1.8 * rng.random()])
    return np.array([*centre, 0.1 + 0.2 * rng.random(), 0.0, 0.0, 0.0, 0.0])
