"""Camera trajectories to motion, with numbers worked by hand."""

from __future__ import annotations

import gzip
import math
import os
from pathlib import Path

import numpy as np
import pytest

from bufgym.errors import BufgymError, TraceError
from bufgym.traces import Motion, MotionSettings, Poses, motion_from_poses, read_motion, write_motion_csv

DATA = Path(os.environ.get("BUFGYM_SHARED_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))

# 1 m forward in the first second, then a turn of 90 degrees about z in the next.
HALF = math.sqrt(0.5)
WALK_AND_TURN = f"""# t tx ty tz qx qy qz qw
100 0 0 0 0 0 0 1
101 1 0 0 0 0 0 1
102 1 0 0 0 0 {HALF} {HALF}
"""


def written(folder: Path, text: str, name: str = "path.txt") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_translation_over_scale_and_rotation_over_field_of_view(tmp_path: Path) -> None:
    motion = read_motion(written(tmp_path, WALK_AND_TURN))
    assert motion.time_us.tolist() == [0, 1_000_000, 2_000_000]
    # 1 m / 2 m = 0.5; 90 degrees / 60 degrees = 1.5.
    assert motion.coordinate == pytest.approx([0.0, 0.5, 2.0])
    assert (motion.name, motion.gaps) == ("path", ())
    other = read_motion(tmp_path / "path.txt", MotionSettings(fov_deg=90, scene_scale_m=4))
    assert other.coordinate == pytest.approx([0.0, 0.25, 1.25])


def test_a_quaternion_and_its_negative_are_one_orientation(tmp_path: Path) -> None:
    text = "0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 -1\n"
    assert read_motion(written(tmp_path, text)).total == pytest.approx(0.0, abs=1e-12)


def test_small_angles_are_not_lost() -> None:
    angle = 1e-7
    quaternions = np.array([[0, 0, 0, 1], [0, 0, math.sin(angle / 2), math.cos(angle / 2)]])
    motion = motion_from_poses(
        Poses(np.array([0, 1_000_000]), np.zeros((2, 3)), quaternions), MotionSettings(fov_deg=math.degrees(1.0))
    )
    assert motion.total == pytest.approx(angle, rel=1e-6)


def test_fast_poses_are_resampled_so_that_jitter_is_not_motion() -> None:
    """A mocap at 300 Hz that stands still and jitters by 0.2 mm: the camera at 30 Hz sees a tenth of it."""
    count = 3001
    time_us = np.rint(np.arange(count) * (1e6 / 300)).astype(np.int64)
    position = np.zeros((count, 3))
    position[:, 0] = 2e-4 * (np.arange(count) % 3 == 1)
    upright = np.tile([0.0, 0, 0, 1], (count, 1))
    poses = Poses(time_us, position, upright)
    every = motion_from_poses(poses, MotionSettings(rate_hz=1000))
    camera = motion_from_poses(poses)
    assert every.time_us.size == count and camera.time_us.size == 301
    assert every.total == pytest.approx(2000 * 2e-4 / 2)
    assert camera.total < every.total / 5


def test_resampling_keeps_a_steady_turn_steady() -> None:
    """One turn a second about z, given at 100 Hz: at 30 Hz each step is 12 degrees."""
    time_us = np.arange(101, dtype=np.int64) * 10_000
    angle = 2 * np.pi * time_us / 1e6
    quaternion = np.stack([0 * angle, 0 * angle, np.sin(angle / 2), np.cos(angle / 2)], axis=1)
    motion = motion_from_poses(Poses(time_us, np.zeros((101, 3)), quaternion), MotionSettings(rate_hz=30))
    assert np.diff(motion.coordinate) == pytest.approx(np.full(30, 12 / 60), rel=1e-3)
    assert motion.total == pytest.approx(6.0)


def test_gaps_are_reported() -> None:
    time_us = np.array([0, 500_000, 3_000_000, 3_500_000])
    position = np.array([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0]])
    motion = motion_from_poses(Poses(time_us, position, np.tile([0.0, 0, 0, 1], (4, 1))))
    assert motion.gaps == ((500_000, 3_000_000),)
    assert motion.at(1_750_000) == pytest.approx(0.25)


def test_past_the_end_the_total_is_carried_on() -> None:
    motion = Motion("m", np.array([0, 10, 20]), np.array([0.0, 1.0, 1.5]))
    assert motion.at([0, 5, 10, 20, 25, 45]).tolist() == [0.0, 0.5, 1.0, 1.5, 2.0, 3.5]
    steps = np.diff(motion.at(np.arange(100)))
    assert (steps >= 0).all()
    with pytest.raises(BufgymError, match="time_us = -1: must be >= 0"):
        motion.at(-1)


def test_round_trip_is_exact(tmp_path: Path) -> None:
    motion = Motion("m", np.array([0, 1, 1_500_000]), np.array([0.0, 1 / 3, 2e5 / 7]))
    write_motion_csv(motion, tmp_path / "m.csv")
    again = read_motion(tmp_path / "m.csv")
    assert again.name == "m"
    assert again.time_us.tolist() == motion.time_us.tolist()
    assert again.coordinate.tolist() == motion.coordinate.tolist()
    with pytest.raises(TraceError, match="cannot be written"):
        write_motion_csv(motion, tmp_path)


def test_gzip_and_repeated_times(tmp_path: Path) -> None:
    path = tmp_path / "path.txt.gz"
    path.write_bytes(gzip.compress(WALK_AND_TURN.replace("101 1", "101 9 9 9 0 0 0 1\n101 1").encode()))
    assert read_motion(path).coordinate == pytest.approx([0.0, 0.5, 2.0])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "path.txt: is empty"),
        ("# only this\n", "path.txt: is empty"),
        ("0 0 0 0 0 0 0 1\n", "holds 1 samples: must hold at least 2"),
        ("0 0 0 0 0 0 0\n", "path.txt, line 1: '0 0 0 0 0 0 0': must have 8 columns, has 7"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 0\n", "line 2: norm of the quaternion = 0: must be 1 within 1 %"),
        ("0 0 0 0 0 0 0 1.02\n", "line 1: norm of the quaternion = 1.02"),
        ("0 0 0 0 0 0 0 1\n1 nan 0 0 0 0 0 1\n", "line 2: tx = nan: must be a finite number"),
        ("0 0 0 1e8 0 0 0 1\n", "line 1: tz = 1e8: must be from -1e\\+07 to 1e\\+07"),
        ("5 0 0 0 0 0 0 1\n4 0 0 0 0 0 0 1\n", "line 2: time in s = 4: must not be before the line above"),
        ("0 0 0 0 0 0 0 1\n2e7 0 0 0 0 0 0 1\n", "line 2: time in s = 2e7: must be at most 10000000 s after"),
        ("1403636579763555584 0 0 0 0 0 0 1\n", "line 1: time in s = 1403636579763555584: must be from 0 to"),
        ("-1 0 0 0 0 0 0 1\n", "line 1: time in s = -1"),
        ("t_s,motion\n0,0\n1,2\n2,1.5\n", "line 4: motion = 1.5: must not be below the line above"),
        ("t_s,motion\n0,0\n1,-2\n", "line 3: motion = -2: must be from 0"),
        ("t_s,motion\n0,0\n1\n", "line 3: 1: must have 2 columns, has 1"),
        ("t_s,motion\n0,0\n", "holds 1 samples"),
    ],
)
def test_broken_files(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(TraceError, match=says):
        read_motion(written(tmp_path, text))


def test_broken_arguments() -> None:
    for name in ("fov_deg", "scene_scale_m", "rate_hz", "max_gap_s"):
        for value in (0.0, float("nan"), -1.0):
            with pytest.raises(BufgymError, match=f"{name} = {value}: must be a finite number above 0"):
                MotionSettings(**{name: value})
    with pytest.raises(BufgymError, match="must increase at index 1"):
        Motion("m", np.array([0, 0]), np.array([0.0, 1.0]))
    with pytest.raises(BufgymError, match="must not decrease at index 2"):
        Motion("m", np.array([0, 1, 2]), np.array([0.0, 1.0, 0.5]))
    with pytest.raises(BufgymError, match="finite"):
        Motion("m", np.array([0, 1]), np.array([0.0, float("nan")]))


# Coordinate gained a second: the desks are hand-held sweeps, xyz is mostly translation, 360 a turning robot.
TUM = {
    "freiburg1_desk": 0.81,
    "freiburg1_desk2": 1.00,
    "freiburg1_rpy": 1.15,
    "freiburg1_xyz": 0.44,
    "freiburg2_desk": 0.27,
    "freiburg2_pioneer_360": 0.42,
}


@pytest.mark.skipif(not (DATA / "tum_rgbd").is_dir(), reason=f"no TUM trajectories under {DATA}")
@pytest.mark.parametrize("name", TUM)
def test_real_trajectories(name: str) -> None:
    motion = read_motion(DATA / "tum_rgbd" / f"{name}.groundtruth.txt.gz")
    assert motion.total / motion.duration_us * 1e6 == pytest.approx(TUM[name], abs=0.006)
    # The README of the data tells of a gap of 12 s in freiburg2_desk.
    longest_s = max((end - start for start, end in motion.gaps), default=0) / 1e6
    assert longest_s == pytest.approx(12.0 if name == "freiburg2_desk" else 0.0, abs=0.1)
