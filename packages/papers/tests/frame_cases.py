"""Small recordings of a depth camera, written to folders, and sequences held in memory."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
from needs import needs

from bufgym_papers.perception.frames import Camera, Depth, Image, Sequence

cv2 = pytest.importorskip("cv2", reason=needs("extras", "cv2"))

WIDTH, HEIGHT = 640, 480
TURNED = np.array([[0.0, -1, 0, 0.5], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""A quarter turn about z, half a metre to the side."""


class Held(Sequence):
    """Depths and poses that a test made."""

    name = "held"

    def __init__(self, camera: Camera, depths: list[Depth], poses: list[np.ndarray]) -> None:
        self.camera, self._depths = camera, depths
        self.poses = np.array(poses, float)
        self.time_us = np.arange(len(depths), dtype=np.int64) * 33_333

    def depth(self, k: int) -> Depth:
        return self._depths[k]

    def image(self, k: int) -> Image:
        return np.zeros(self._depths[k].shape, np.uint8)

    def size_bytes(self, k: int) -> int:
        return 1000 * (k + 1)


def png(value: int, dtype: type = np.uint16, shape: tuple[int, ...] = (HEIGHT, WIDTH)) -> bytes:
    return cv2.imencode(".png", np.full(shape, value, dtype))[1].tobytes()


def tum(folder: Path) -> Path:
    """Three depth images at 2 m, 10.00, 10.03 and 10.06 s; the third has no picture."""
    (folder / "depth").mkdir(parents=True)
    (folder / "rgb").mkdir()
    for k in range(3):
        (folder / f"depth/{k}.png").write_bytes(png(10_000 + 5000 * k))
        (folder / f"rgb/{k}.png").write_bytes(png(50 * k, np.uint8, (HEIGHT, WIDTH, 3)))
    (folder / "depth.txt").write_text("# depth\n10.00 depth/0.png\n10.03 depth/1.png\n10.09 depth/2.png\n")
    (folder / "rgb.txt").write_text("10.01 rgb/0.png\n10.04 rgb/1.png\n")
    # From the origin to 1 m along x in 0.1 s, without turning.
    (folder / "groundtruth.txt").write_text("# truth\n9.99 0 0 0 0 0 0 1\n10.09 1 0 0 0 0 0 1\n")
    return folder


def seven_scenes(folder: Path) -> Path:
    """Two frames at 1 and 1.5 m."""
    folder.mkdir(parents=True)
    for k, pose in enumerate((np.eye(4), TURNED)):
        stem = folder / f"frame-{k:06d}"
        Path(f"{stem}.depth.png").write_bytes(png(1000 + 500 * k))
        Path(f"{stem}.color.png").write_bytes(png(9, np.uint8, (HEIGHT, WIDTH, 3)))
        Path(f"{stem}.pose.txt").write_text("\n".join(" ".join(str(x) for x in row) for row in pose))
    return folder


def packed(folder: Path) -> Path:
    """The same at half size, in archives."""
    folder.mkdir(parents=True)
    with zipfile.ZipFile(folder / "depth_320x240_mm.zip", "w") as archive:
        for k in range(2):
            archive.writestr(f"{k:04d}.png", png(1000 + 500 * k, shape=(240, 320)))
    with zipfile.ZipFile(folder / "gray_320x240.zip", "w") as archive:
        for k in range(2):
            archive.writestr(f"{k:04d}.jpg", cv2.imencode(".jpg", np.full((240, 320), 77, np.uint8))[1].tobytes())
    lines = [" ".join(str(x) for x in pose.ravel()) for pose in (np.eye(4), TURNED)]
    (folder / "poses_camera_to_world.txt").write_text("\n".join(lines))
    return folder
