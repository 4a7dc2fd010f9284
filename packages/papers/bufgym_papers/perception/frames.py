"""Frames of a depth camera, with the true pose of each: what a robot records and sends.

Cameras look along z, x is right and y down, as in OpenCV. A pixel (u, v) with depth z is the point
((u - cx) z / fx, (v - cy) z / fy, z), in metres; a pose takes it to the world. Depth 0 is no measurement.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from bufgym.traces.motion import Motion, MotionSettings, motion_from_poses
from bufgym.traces.poses import Poses, quaternions
from bufgym.traces.trace import Float64Array, Int64Array
from bufgym.utils.errors import BufgymError
from bufgym.utils.libraries import library

Depth = npt.NDArray[np.float32]
"""float32[height, width], metres; 0 where nothing was measured."""
Image = npt.NDArray[np.uint8]
"""uint8[height, width], or [height, width, 3] in the order blue, green, red."""

SENT_WIDTH: Final = 640  # Frames are sent at the size at which a Kinect takes them, 640x480
JPEG_QUALITY: Final = 50  # The paper sends "a low-quality JPEG" beside the depth


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; all in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def fov_deg(self) -> float:
        return float(np.degrees(2 * np.arctan(self.width / (2 * self.fx))))

    @property
    def lens(self) -> Float64Array:
        """The same for kernels, float64[4]: fx, fy, cx, cy."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    def every(self, stride: int) -> Camera:
        """The camera of every ``stride``-th pixel of every ``stride``-th row, the first among them."""
        if stride < 1 or self.width % stride or self.height % stride:
            raise BufgymError(f"stride = {stride}: must divide {self.width} x {self.height}")
        small = {name: getattr(self, name) / stride for name in ("fx", "fy", "cx", "cy")}
        return replace(self, width=self.width // stride, height=self.height // stride, **small)


class Sequence(ABC):
    """A recording: frames in the order of time, each with its true pose."""

    name: str  # what to call it in tables
    camera: Camera  # of depth and image alike
    time_us: Int64Array  # int64[n], microseconds, increasing from 0
    poses: Float64Array  # float64[n, 4, 4], camera to world, metres

    def __len__(self) -> int:
        return len(self.time_us)

    @abstractmethod
    def depth(self, k: int) -> Depth:
        """Of frame k."""

    @abstractmethod
    def image(self, k: int) -> Image:
        """The picture of frame k, grey or in colours. Raises as `depth`."""

    def grey(self, k: int) -> Image:
        """The picture of frame k, uint8[height, width]."""
        image = self.image(k)
        return (
            image
            if image.ndim == 2
            else np.asarray(library("cv2", "bufgym-papers[perception]").cvtColor(image, 6), np.uint8)
        )  # BGR to grey

    def size_bytes(self, k: int) -> int:
        """How long frame k is when it is sent: its depth by RVL and its picture by JPEG, both encoded to find out.

        Frames that are smaller than 640x480 are brought to that size first: pixels of the depth are repeated, the
        picture is scaled.
        """
        return encoded_bytes(self.depth(k), self.image(k))

    def motion(self) -> Motion:
        """How far the scene has moved on, by the true poses and this camera's field of view."""
        settings = MotionSettings(fov_deg=self.camera.fov_deg)
        poses = Poses(self.time_us, self.poses[:, :3, 3], quaternions(self.poses[:, :3, :3]))
        return motion_from_poses(poses, settings, name=self.name)

    def first(self, frames: int) -> Sequence:
        """Select the recording's first frames, or all if there are no more."""
        return self if len(self) <= frames else _Part(self, frames)

    def reduced(self, stride: int) -> Sequence:
        """Every ``stride``-th pixel of every ``stride``-th row. No averaging: that would invent depths at edges."""
        return self if stride == 1 else _Part(self, len(self), stride)

    def loaded(self) -> Sequence:
        """The same with its depths in memory, for those who use them again and again; pictures stay where they are."""
        part = _Part(self, len(self))
        part.held = [self.depth(k) for k in range(len(self))]
        return part


class _Part(Sequence):
    """The first ``frames`` of a recording, and of each every ``stride``-th pixel."""

    def __init__(self, whole: Sequence, frames: int, stride: int = 1) -> None:
        self.name, self.camera = whole.name, whole.camera.every(stride)
        self.time_us, self.poses = whole.time_us[:frames], whole.poses[:frames]
        self.held: list[Depth] = []
        self._whole, self._stride = whole, stride

    def depth(self, k: int) -> Depth:
        if self.held:
            return self.held[k]
        return np.ascontiguousarray(self._whole.depth(k)[:: self._stride, :: self._stride])

    def image(self, k: int) -> Image:
        return np.ascontiguousarray(self._whole.image(k)[:: self._stride, :: self._stride])

    def size_bytes(self, k: int) -> int:
        return self._whole.size_bytes(k)  # it is still the whole frame that is sent


def encoded_bytes(depth: Depth, image: Image) -> int:
    """Bytes of the depth by RVL (Wilson, "Fast Lossless Depth Image Compression", ISS 2017) and of the picture by JPEG.

    RVL stores each run of unmeasured pixels by its length, and of the others the difference to the one before, in mm.
    """
    cv2, rvl = library("cv2", "bufgym-papers[perception]"), library("rvl", "bufgym-papers[perception]")
    repeat = max(1, SENT_WIDTH // depth.shape[1])
    depth_mm = np.rint(depth * 1000).astype(np.uint16).repeat(repeat, 0).repeat(repeat, 1)
    if repeat > 1:
        image = cv2.resize(image, (depth_mm.shape[1], depth_mm.shape[0]))
    picture = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    return len(rvl.compress(depth_mm)) + len(picture)
