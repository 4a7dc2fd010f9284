"""Recordings of depth cameras: read as they were written, and one clear error for each way in which they are broken."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import frame_cases
import numpy as np
import pytest
from refusal_cases import refuse

from bufgym.ground.errors import BufgymError
from bufgym.ground.libraries import library
from bufgym.papers.perception.frames import Camera, encoded_bytes
from bufgym.papers.perception.recordings import open_sequence

LAYOUTS = {"tum": frame_cases.tum, "7-scenes": frame_cases.seven_scenes, "packed": frame_cases.packed}


@pytest.mark.parametrize(
    ("layout", "time_us", "metres", "x_m"),
    [
        # 5000 units are a metre; the third depth image has no picture within 20 ms; 10 and 40 of 100 ms of the way.
        ("tum", [0, 30_000], [2.0, 3.0], [0.1, 0.4]),
        ("7-scenes", [0, 33_333], [1.0, 1.5], [0.0, 0.5]),
        ("packed", [0, 33_333], [1.0, 1.5], [0.0, 0.5]),
    ],
)
def test_every_layout_is_recognised(layout: str, time_us: Any, metres: Any, x_m: Any, tmp_path: Path) -> None:
    sequence = open_sequence(LAYOUTS[layout](tmp_path / "desk"))
    camera = sequence.camera
    assert (sequence.name, len(sequence), sequence.poses.shape) == ("desk", 2, (2, 4, 4))
    assert sequence.time_us.tolist() == time_us and sequence.poses[:, 0, 3] == pytest.approx(x_m)
    for k in range(2):
        depth = sequence.depth(k)
        assert depth.dtype == np.float32 and float(depth[7, 7]) == metres[k]
        assert depth.shape == sequence.grey(k).shape == (camera.height, camera.width)
    assert sequence.grey(1)[0, 0] == {"tum": 50, "7-scenes": 9, "packed": 77}[layout]
    if layout == "7-scenes":
        # A quarter turn is 90 of the camera's 57.4 degrees, half a metre a quarter of the scene's scale.
        assert sequence.poses[1] == pytest.approx(frame_cases.TURNED)
        assert camera.fov_deg == pytest.approx(57.36, abs=0.01)
        assert sequence.motion().total == pytest.approx(90 / camera.fov_deg + 0.25)


CHANGES: dict[str, Callable[[bytes], bytes | None]] = {
    "gone": lambda data: None,
    "cut": lambda data: data[:-20],
    "text": lambda data: b"1 2 3",
    "outside": lambda data: data.replace(b"depth/0", b"../0"),
}


@pytest.mark.parametrize(
    ("layout", "file", "change", "rule"),
    [
        ("tum", "depth/1.png", "gone", "no such file"),
        ("tum", "depth/1.png", "cut", "truncated or damaged"),
        ("tum", "groundtruth.txt", "text", "must have 8 columns, has 3"),
        ("7-scenes", "frame-000001.pose.txt", "text", "must be a 4x4 matrix"),
        ("packed", "poses_camera_to_world.txt", "text", "line 1: '1 2 3': must be a 4x4 matrix"),
        ("packed", "depth_320x240_mm.zip", "cut", "truncated, or no zip archive"),
        ("tum", "depth.txt", "outside", "line 2: file = ../0.png: must be a path inside the folder"),
    ],
)
def test_what_is_broken_is_one_error(layout: str, file: str, change: str, rule: str, tmp_path: Path) -> None:
    folder = LAYOUTS[layout](tmp_path / "desk")
    changed = CHANGES[change]((folder / file).read_bytes())
    (folder / file).unlink()
    if changed is not None:
        (folder / file).write_bytes(changed)
    with pytest.raises(BufgymError) as raised:
        sequence = open_sequence(folder)
        for k in range(2):
            sequence.depth(k)
            sequence.image(k)
    message = str(raised.value)
    assert Path(file).name in message and rule in message and "\n" not in message


def test_missing_measurements_poses_that_drifted_and_reduced_frames(tmp_path: Path) -> None:
    folder = frame_cases.seven_scenes(tmp_path / "desk")
    (folder / "frame-000000.depth.png").write_bytes(frame_cases.png(65535))
    (folder / "frame-000000.pose.txt").write_text("1.001 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1")
    sequence = open_sequence(folder)
    assert not sequence.depth(0).any() and sequence.poses[0, :3, :3] == pytest.approx(np.eye(3), abs=1e-12)
    depth = np.arange(8, dtype=np.float32).reshape(2, 4)
    whole = frame_cases.Held(Camera(4, 2, 8.0, 8.0, 2.0, 1.0), [depth], [np.eye(4)])
    half = whole.reduced(2).loaded()
    assert half.depth(0).tolist() == [[0.0, 2.0]] and half.camera == Camera(2, 1, 4.0, 4.0, 1.0, 0.5)
    refuse("stride = 3: must divide 4 x 2", whole.reduced, 3)


def test_no_recording_and_no_library(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder, says in ((tmp_path, r"depth\.txt \(TUM\)"), (tmp_path / "desk", "no such folder")):
        refuse(says, open_sequence, folder)
    monkeypatch.setitem(sys.modules, "rvl", None)
    refuse(r"bufgym needs rvl: pip install .*perception", library, "rvl")


def test_the_size_of_a_frame() -> None:
    # An even wall costs a nibble for each of 307 200 pixels, 150 kB; where nothing was measured, nearly none.
    grey = np.full((480, 640), 90, np.uint8)
    picture = len(library("cv2").imencode(".jpg", grey, [1, 50])[1])
    wall = encoded_bytes(np.full((480, 640), 1.5, np.float32), grey)
    assert 0 <= wall - picture - 640 * 480 // 2 < 32
    assert encoded_bytes(np.zeros((480, 640), np.float32), grey) - picture < 32
    # Half a frame is doubled before.
    assert encoded_bytes(np.full((240, 320), 1.5, np.float32), grey[::2, ::2]) == wall
