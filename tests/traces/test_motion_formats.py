"""TUM, EuRoC and KITTI trajectories: the same path reads the same; orientations between poses; real files."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bufgym.errors import BufgymError, TraceError
from bufgym.traces import MotionSettings, read_motion
from bufgym.traces.formats.trajectories import detect_pose_format, read_poses
from bufgym.traces.poses import Poses, angles, quaternions, slerp

# 1 m forward in the first second, then a turn of 90 degrees about z in the next: x = 0, 0.5, 2.
H = math.sqrt(0.5)
TUM = f"100 0 0 0 0 0 0 1\n101 1 0 0 0 0 0 1\n102 1 0 0 0 0 {H} {H}\n"
# EuRoC's times are ns, and its quaternions begin with w.
EUROC = f"""#timestamp [ns] p_RS_R_x [m] p_RS_R_y [m] p_RS_R_z [m] q_RS_w [] q_RS_x [] q_RS_y [] q_RS_z []
1403636580863555584.0000000000 0 0 0 1 0 0 0
1403636581863555584.0000000000 1 0 0 1 0 0 0
1403636582863555584.0000000000 1 0 0 {H} 0 0 {H}
"""
EUROC_CSV = (
    "#timestamp, p_RS_R_x [m], ..., b_a_RS_S_z [m s^-2]\n"
    + "\n".join(
        line.replace(".0000000000", "").replace(" ", ",") + ",1,2,3,4,5,6,7,8,9" for line in EUROC.split("\n")[1:4]
    )
    + "\n"
)
KITTI = "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 0 0 0 1 0\n0 -1 0 1 1 0 0 0 0 0 1 0\n"
KITTI_TIMES = "0.000000e+00\n1.000000e+00\n2.000000e+00\n"


def written(folder: Path, text: str, name: str = "path.txt") -> Path:
    path = folder / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("format", "text"), [("tum", TUM), ("euroc", EUROC), ("euroc", EUROC_CSV), ("kitti", KITTI)], ids=str
)
def test_one_path_in_each_format(tmp_path: Path, format: str, text: str) -> None:
    path = written(tmp_path, text)
    written(tmp_path, KITTI_TIMES, "path_times.txt")
    assert detect_pose_format(path) == format
    motion = read_motion(path)
    assert motion.time_us.tolist() == [0, 1_000_000, 2_000_000]
    assert motion.coordinate == pytest.approx([0.0, 0.5, 2.0])
    assert f"format {format}" in motion.source
    assert read_motion(path, MotionSettings(fov_deg=90, scene_scale_m=4)).coordinate == pytest.approx([0, 0.25, 1.25])
    assert read_motion(path, MotionSettings(max_gap_s=0.5)).gaps == ((0, 1_000_000), (1_000_000, 2_000_000))
    assert read_motion(path, MotionSettings(max_gap_s=0.5)).longest_gap_s == 1.0
    zipped = tmp_path / "path.txt.gz"
    zipped.write_bytes(gzip.compress(path.read_bytes()))
    assert read_motion(zipped).coordinate.tolist() == motion.coordinate.tolist()


def test_times_in_ns_are_exact(tmp_path: Path) -> None:
    """As a float, 1403636580863555584 ns is known to 256 ns only."""
    lines = [f"14036365808635{k:05d} 0 0 0 1 0 0 0" for k in (0, 1000, 2999, 55584)]
    poses = read_poses(written(tmp_path, "# timestamp[ns] px py pz qw qx qy qz\n" + "\n".join(lines)))
    assert poses.time_us.tolist() == [0, 1, 2, 55]


def test_kitti_times_from_elsewhere(tmp_path: Path) -> None:
    path = written(tmp_path, KITTI, "00.txt")
    with pytest.raises(TraceError, match=r"holds KITTI matrices, which carry no time: .*no 00_times.txt beside"):
        read_motion(path)
    times = written(tmp_path, KITTI_TIMES, "times.txt")
    assert read_motion(path, times=times).total == pytest.approx(2.0)
    for text, says in (
        ("0\n1\n", r"00.txt, line 3: must have a time, but .*times.txt has no more"),
        (KITTI_TIMES + "3\n", "holds more times than .*00.txt has poses"),
        ("0\n2\n1\n", r"00.txt, line 3: time in s = 1: must not be before the line above"),
        ("0\n1 1\n2\n", "times.txt, line 2: '1 1': must have 1 columns, has 2"),
        ("0\n-1\n2\n", "times.txt, line 2: time in s = -1"),
    ):
        times.write_text(text)
        with pytest.raises(TraceError, match=says):
            read_motion(path, times=times)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("#timestamp [ns] ...\n1 0 0 0 1 0 0\n", r"line 2: '1 0 0 0 1 0 0': must have 8 columns \(or the 17 of"),
        ("#timestamp [ns] ...\n1 0 0 0 0 0 0 0\n", "line 2: norm of the quaternion = 0"),
        ("#timestamp [ns] ...\n1e99 0 0 0 1 0 0 0\n", "line 2: time in ns = 1e99: must be from 0 to 1e[+]20"),
        ("1,0,0,0,1,0,x,0\n", "line 1: qy = x: must be a finite number"),
        ("1 0 0 0 0 1 0 0 0 0 2 0\n", "must be a rotation within 1 %"),
        # A reflection: orthogonal, but no rotation.
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", "must be a rotation within 1 %"),
        ("1 0 0 1e9 0 1 0 0 0 0 1 0\n", "line 1: number 4 = 1e9: must be from -1e[+]07 to 1e[+]07"),
        # Nanoseconds without EuRoC's header could be anybody's: not guessed.
        ("1403636579763555584 0 0 0 0 0 0 1\n", "line 1: time in s = 1403636579763555584: must be from 0 to"),
    ],
)
def test_broken_files(tmp_path: Path, text: str, says: str) -> None:
    written(tmp_path, KITTI_TIMES, "path_times.txt")
    with pytest.raises(TraceError, match=says):
        read_poses(written(tmp_path, text))


def test_formats_that_do_not_exist_or_do_not_fit(tmp_path: Path) -> None:
    path = written(tmp_path, TUM)
    with pytest.raises(BufgymError, match="format = 'bvh': must be one of tum, euroc, kitti"):
        read_motion(path, format="bvh")
    with pytest.raises(BufgymError, match=r"times = 't\.txt': goes with KITTI matrices only"):
        read_motion(path, times="t.txt")
    with pytest.raises(TraceError, match=r"line 1: .*must have 12 columns, has 8"):
        read_motion(path, format="kitti", times=written(tmp_path, KITTI_TIMES, "times.txt"))


def about(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    half = math.radians(degrees) / 2
    return np.array([*(math.sin(half) * np.array(axis) / np.linalg.norm(axis)), math.cos(half)])


def test_slerp_turns_evenly_and_the_short_way() -> None:
    """From 10 to 130 degrees about (1, 1, 0): a quarter of the way is 40 degrees; a chord would give 36.1."""
    start, end = about((1, 1, 0), 10), about((1, 1, 0), 130)
    for sign in (1, -1):
        quarter = slerp(start[None], sign * end[None], np.array([[0.25]]))
        assert np.degrees(angles(quarter, about((1, 1, 0), 40)[None])) == pytest.approx([0], abs=1e-6)
        assert np.degrees(angles(start[None], sign * end[None])) == pytest.approx([120])
    # From 350 to 10 degrees the short way is through 0.
    middle = slerp(about((0, 0, 1), 350)[None], about((0, 0, 1), 10)[None], np.array([[0.5]]))
    assert np.degrees(angles(middle, about((0, 0, 1), 0)[None])) == pytest.approx([0], abs=1e-6)


def test_poses_between_poses() -> None:
    time_us = np.array([0, 2_000_000, 3_000_000])
    quaternion = np.stack([about((0, 0, 1), degrees) for degrees in (0, 100, 100)])
    poses = Poses(time_us, np.array([[0.0, 0, 0], [4, 0, 0], [4, 2, 0]]), quaternion)
    between = poses.at(np.array([0, 500_000, 2_500_000, 3_000_000]))
    assert between.position_m.tolist() == [[0, 0, 0], [1, 0, 0], [4, 1, 0], [4, 2, 0]]
    turned = np.degrees(angles(between.quaternion, quaternion[[0]].repeat(4, axis=0)))
    assert turned == pytest.approx([0, 25, 100, 100], abs=1e-6)
    # Twice a second, and the end.
    assert poses.resampled(2).time_us.tolist() == [0, 500_000, 1_000_000, 1_500_000, 2_000_000, 2_500_000, 3_000_000]


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1))
def test_matrices_to_quaternions_and_back(numbers: tuple[float, float, float, float]) -> None:
    """Whichever component is the largest; q and -q are one rotation."""
    x, y, z, w = np.array(numbers) / math.hypot(*numbers)
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    computed = quaternions(matrix[None])[0]
    expected = np.array([x, y, z, w])
    assert min(np.abs(computed - expected).max(), np.abs(computed + expected).max()) < 1e-12


def lengths(path: Path, euroc: bool) -> float:
    """Metres of the way, straight from the columns: an independent reading."""
    rows = [line.split() for line in gzip.decompress(path.read_bytes()).decode().split("\n") if line and line[0] != "#"]
    position = np.array([row[1:4] if euroc else row[3::4] for row in rows], np.float64)
    return float(np.linalg.norm(np.diff(position, axis=0), axis=1).sum())


EUROC_FILES = [
    "MH_01_easy", "MH_02_easy", "MH_03_medium", "MH_04_difficult", "MH_05_difficult", "V1_01_easy", "V1_02_medium",
    "V1_03_difficult",
]  # fmt: skip


@pytest.mark.parametrize("name", EUROC_FILES)
def test_real_euroc(shared_data: Path, name: str) -> None:
    path = shared_data / "euroc" / f"{name}.txt.gz"
    if not path.exists():
        pytest.skip(f"trajectory absent: euroc/{name}.txt.gz")
    # A field of view of 10**9 degrees leaves the translation alone; 20 Hz is below 30, so nothing is resampled.
    motion = read_motion(path, MotionSettings(fov_deg=1e9, scene_scale_m=1))
    assert motion.total == pytest.approx(lengths(path, euroc=True), rel=1e-6)
    assert np.median(np.diff(motion.time_us)) == pytest.approx(50_000, abs=2)
    assert read_motion(path).total > motion.total / 2


def test_real_kitti(shared_data: Path) -> None:
    path = shared_data / "kitti" / "KITTI_00_gt.txt.gz"
    if not path.exists():
        pytest.skip("trajectory absent: kitti/KITTI_00_gt.txt.gz")
    motion = read_motion(path, MotionSettings(fov_deg=1e9, scene_scale_m=1))
    # Sequence 00 is 3.7 km long, 4541 poses in 470.6 s; its times come from KITTI_00_gt_times.txt.gz.
    assert motion.total == pytest.approx(3724, abs=1) and motion.total == pytest.approx(lengths(path, euroc=False))
    assert (motion.time_us.size, motion.gaps) == (4541, ())
    assert motion.duration_us / 1e6 == pytest.approx(470.6, abs=0.1)
    assert "times from KITTI_00_gt_times.txt.gz" in motion.source
