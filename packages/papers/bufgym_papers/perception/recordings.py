"""Recordings of depth cameras in folders.

| layout | known by | frames |
|---|---|---|
| TUM RGB-D | `depth.txt`, `rgb.txt`, `groundtruth.txt` | PNG, 1/5000 m; the picture nearest in time |
| 7-Scenes | `frame-000000.depth.png`, `.color.png`, `.pose.txt` | PNG, mm, 65535 = none |
| 7-Scenes, packed | `depth_320x240_mm.zip`, `gray_320x240.zip`, `poses_camera_to_world.txt` | the same at half size |

Frames are read when they are asked for.
"""

import re
import zipfile
from collections.abc import Sequence as Seq
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Final

import numpy as np

from bufgym.traces.formats.text import open_text
from bufgym.traces.formats.trajectories import read_poses, seconds
from bufgym.traces.poses import Poses, gaps_between, rotations
from bufgym.traces.trace import US_PER_S, Float64Array, Int64Array
from bufgym.utils.errors import BufgymError, where
from bufgym.utils.files import read_utf8, read_whole
from bufgym.utils.libraries import library
from bufgym_papers.perception.frames import Camera, Depth, Image, Sequence

TUM_CAMERA: Final = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
"""ROS's default numbers, which the publishers advise for all sequences because the depth was registered with them."""
SEVEN_SCENES_CAMERA: Final = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
TUM_UNITS_PER_M: Final = 5000.0
MM_PER_M: Final = 1000.0
SEVEN_SCENES_HZ: Final = 30.0
SAME_MOMENT_S: Final = 0.02  # Most time between a depth and its picture, as in the publishers' associate.py, s
POSE_GAP_S: Final = 0.1
"""Longest gap in the ground truth across which poses are interpolated, s; frames in longer gaps are left out."""

_MOST_IMAGE_BYTES: Final = 16 * 2**20
_MOST_TEXT_BYTES: Final = 2**26
_KINDS: Final = ("depth", "color")
_ROTATION_TOLERANCE: Final = 0.01
_ENDS: Final = {b"\x89PNG": b"IEND\xaeB`\x82", b"\xff\xd8\xff": b"\xff\xd9"}
"""First bytes of an image file -> last bytes of a complete one."""


File = Path | zipfile.Path


@dataclass(eq=False)
class ImageFiles(Sequence):
    """Frames in image files of their own."""

    name: str
    camera: Camera
    time_us: Int64Array
    poses: Float64Array
    depths: Seq[File]  # the depth's file of each frame
    images: Seq[File]  # the picture's
    units_per_m: float = MM_PER_M

    def depth(self, k: int) -> Depth:
        units = self._decoded(self.depths[k])
        if units.dtype != np.uint16 or units.ndim != 2:
            raise BufgymError(f"{self.depths[k]}: must be a depth image, 16 bits a pixel, one channel")
        units[units == 65535] = 0  # some recorders write that for "nothing measured"
        return (units / self.units_per_m).astype(np.float32)

    def image(self, k: int) -> Image:
        image = self._decoded(self.images[k])
        if image.dtype != np.uint8 or image.shape[2:] not in ((), (3,)):
            raise BufgymError(f"{self.images[k]}: must be a picture, 8 bits, one channel or three")
        return image

    def _decoded(self, file: File) -> np.ndarray:
        data = read_whole(file, _MOST_IMAGE_BYTES) if isinstance(file, Path) else _unzipped(file)
        end = next((end for begin, end in _ENDS.items() if data.startswith(begin)), None)
        if end is None:
            raise BufgymError(f"{file}: must be a PNG or JPEG image")
        pixels = None
        if end in data[-64:]:  # of a cut file the library would guess the rest, or write to the terminal
            cv2 = library("cv2", "bufgym-papers[perception]")
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if pixels is None:
            raise BufgymError(f"{file}: truncated or damaged: must be a whole image")
        if pixels.shape[:2] != (self.camera.height, self.camera.width):
            size, rule = f"{pixels.shape[1]} x {pixels.shape[0]}", f"must be {self.camera.width} x {self.camera.height}"
            raise BufgymError(where(str(file), None, size, rule, field="size"))
        return np.asarray(pixels)


def _unzipped(file: zipfile.Path) -> bytes:
    try:
        if file.root.getinfo(file.at).file_size > _MOST_IMAGE_BYTES:
            raise BufgymError(f"{file}: must be at most {_MOST_IMAGE_BYTES} bytes")
        return file.read_bytes()
    except KeyError:
        raise BufgymError(f"{file}: no such file, but a pose") from None
    except (zipfile.BadZipFile, OSError, EOFError) as error:
        raise BufgymError(f"{file}: damaged ({error})") from None


def open_sequence(path: str | PathLike[str]) -> Sequence:
    """Open the recording in a folder, whose files tell the layout: TUM RGB-D, 7-Scenes, or 7-Scenes in zip archives."""
    folder = Path(path)
    if not folder.is_dir():
        raise BufgymError(f"{folder}: no such folder")
    if (folder / "depth.txt").is_file():
        return _tum(folder)
    if poses := sorted(folder.glob("frame-*.pose.txt")):
        matrix = np.stack([_pose(file, read_utf8(file, _MOST_TEXT_BYTES)) for file in poses])
        depths, images = ([Path(f"{str(p).removesuffix('pose.txt')}{kind}.png") for p in poses] for kind in _KINDS)
        return ImageFiles(folder.name, SEVEN_SCENES_CAMERA, _at_30_hz(len(poses)), matrix, depths, images)
    if archives := sorted(folder.glob("depth_*_mm.zip")):
        return _packed(folder, archives[0])
    rule = "holds no recording: must hold depth.txt (TUM), frame-*.pose.txt (7-Scenes) or depth_*_mm.zip"
    raise BufgymError(f"{folder}: {rule}")


def _packed(folder: Path, depth: Path) -> Sequence:
    """One sequence of 7-Scenes in two archives, reduced to every second pixel of every second row."""
    size = re.fullmatch(r"depth_(\d+)x(\d+)_mm", depth.stem)
    stride = SEVEN_SCENES_CAMERA.width // max(1, int(size[1])) if size else 0
    camera = SEVEN_SCENES_CAMERA.every(max(1, stride))
    if size is None or (camera.width, camera.height) != (int(size[1]), int(size[2])):
        raise BufgymError(f"{depth}: its name must give a size that divides 640x480, as depth_320x240_mm.zip")
    truth = folder / "poses_camera_to_world.txt"
    lines = read_utf8(truth, _MOST_TEXT_BYTES).splitlines()
    poses = np.stack([_pose(truth, line, number) for number, line in enumerate(lines, 1)])
    files = []
    for path, kind in ((depth, "png"), (folder / f"gray_{size[1]}x{size[2]}.zip", "jpg")):
        try:
            archive = zipfile.ZipFile(path)
        except FileNotFoundError:
            raise BufgymError(f"{path}: no such file") from None
        except (zipfile.BadZipFile, OSError) as error:
            raise BufgymError(f"{path}: truncated, or no zip archive ({error})") from None
        files.append([zipfile.Path(archive, f"{k:04d}.{kind}") for k in range(len(lines))])
    depths, images = files
    return ImageFiles(folder.name, camera, _at_30_hz(len(lines)), poses, depths, images)


def _tum(folder: Path) -> Sequence:
    """TUM RGB-D: a frame for each depth image that has a picture and a pose."""
    depth_us, depths = _listed(folder / "depth.txt")
    image_us, images = _listed(folder / "rgb.txt")
    truth = folder / "groundtruth.txt"
    poses, start_us = read_poses(truth, format="tum"), _first_us(truth)
    nearest = np.clip(np.searchsorted(image_us, depth_us), 1, len(image_us) - 1)
    nearest -= depth_us - image_us[nearest - 1] < image_us[nearest] - depth_us
    kept = np.abs(image_us[nearest] - depth_us) <= SAME_MOMENT_S * US_PER_S
    kept &= (depth_us >= start_us) & (depth_us <= start_us + poses.time_us[-1])
    for gap_start, gap_end in gaps_between(poses.time_us, POSE_GAP_S):
        kept &= (depth_us <= start_us + gap_start) | (depth_us >= start_us + gap_end)
    if kept.sum() < 2:
        raise BufgymError(f"{folder}: {kept.sum()} depth images have a picture and a pose: must be at least 2")
    chosen = np.flatnonzero(kept)
    files = [folder / depths[k] for k in chosen], [folder / images[nearest[k]] for k in chosen]
    time_us, matrix = depth_us[kept] - depth_us[kept][0], matrices(poses.at(depth_us[kept] - start_us))
    return ImageFiles(folder.name, TUM_CAMERA, time_us, matrix, *files, TUM_UNITS_PER_M)


def _listed(path: Path) -> tuple[Int64Array, list[str]]:
    """Read a TUM list with `time file` per line; return times in microseconds and files."""
    times: list[int] = []
    names: list[str] = []
    with open_text(path) as file:
        for line in file.lines():
            if line.text.startswith("#"):
                continue
            time, name = line.columns(2)
            if Path(name).is_absolute() or ".." in Path(name).parts:
                raise line.error(name, "must be a path inside the folder", "file")
            times.append(seconds(line, time))
            if times[-2:] != sorted(set(times[-2:])):
                raise line.error(time, "must be after the line above", "time in s")
            names.append(name)
    if len(times) < 2:
        raise BufgymError(f"{path}: lists {len(times)} images: must list at least 2")
    return np.array(times, np.int64), names


def _first_us(path: Path) -> int:
    """The first time of a trajectory, microseconds."""
    with open_text(path) as file:
        return next(seconds(line, line.columns(8)[0]) for line in file.lines() if not line.text.startswith("#"))


def matrices(poses: Poses) -> Float64Array:
    """float64[n, 4, 4], camera to world."""
    result = np.tile(np.eye(4), (len(poses.time_us), 1, 1))
    result[:, :3, :3], result[:, :3, 3] = rotations(poses.quaternion), poses.position_m
    return result


def _pose(path: Path, text: str, line: int | None = None) -> Float64Array:
    """Read a 4x4 matrix row by row; its rotation, which recorders let drift, is made orthonormal again."""
    rule = "must be a 4x4 matrix: 16 finite numbers, the left upper 3x3 a rotation within 1 %, the last row 0 0 0 1"
    try:
        matrix = np.array([float(number) for number in text.split()]).reshape(4, 4)
    except ValueError:
        raise BufgymError(where(path, line, text, rule)) from None
    rotation = matrix[:3, :3]
    whole = np.isfinite(matrix).all() and (matrix[3] == (0, 0, 0, 1)).all()
    off = np.abs(rotation @ rotation.T - np.eye(3)).max() if whole else np.inf
    if off > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        raise BufgymError(where(path, line, text, rule))
    left, _, right = np.linalg.svd(rotation)
    matrix[:3, :3] = left @ right
    return matrix


def _at_30_hz(count: int) -> Int64Array:
    return np.asarray(np.rint(np.arange(count) * (US_PER_S / SEVEN_SCENES_HZ)), np.int64)
