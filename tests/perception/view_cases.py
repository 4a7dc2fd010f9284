"""A recording made by hand: a camera in front of a flat wall."""

from __future__ import annotations

import numpy as np

from bufgym.perception.frames import Camera, Depth, Image, Sequence


class Wall(Sequence):
    """A wall 2 m ahead of a camera that looks along z and moves to the right; a pixel is 10 cm wide there."""

    def __init__(self, right_m: list[float], depth_m: float = 2.0) -> None:
        self.name, self.camera = "wall", Camera(40, 30, 20.0, 20.0, 19.5, 14.5)
        self.time_us = np.arange(len(right_m)) * 33_333
        self.poses = np.tile(np.eye(4), (len(right_m), 1, 1))
        self.poses[:, 0, 3] = right_m
        self.depths = np.full((len(right_m), 30, 40), depth_m, np.float32)

    def depth(self, k: int) -> Depth:
        return self.depths[k]

    def image(self, k: int) -> Image:
        return np.zeros((30, 40), np.uint8)

    def size_bytes(self, k: int) -> int:
        return 1000 * (k + 1)
