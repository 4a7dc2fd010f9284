"""Camera trajectories of every format to motion, with numbers worked by hand; and real ones."""

import gzip
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from link_files import written
from recording_cases import fetched
from refusal_cases import refuse

from bufgym.traces import Motion, MotionSettings, Poses, motion_from_poses, read_motion, write_motion_csv
from bufgym.traces.formats.trajectories import read_poses
from bufgym.traces.poses import angles, quaternions, rotations, slerp
from bufgym.utils.errors import TraceError

# 1 m forward in the first second, then a turn of 90 degrees about z in the next: 1 / 2 m = 0.5; 90 / 60 degrees = 1.5.
H = math.sqrt(0.5)
TUM = f"# t tx ty tz qx qy qz qw\n100 0 0 0 0 0 0 1\n101 1 0 0 0 0 0 1\n102 1 0 0 0 0 {H} {H}\n"
# EuRoC's times are ns, and its quaternions begin with w.
EUROC = f"""#timestamp [ns] p_RS_R_x [m] p_RS_R_y [m] p_RS_R_z [m] q_RS_w [] q_RS_x [] q_RS_y [] q_RS_z []
1403636580863555584.0000000000 0 0 0 1 0 0 0
1403636581863555584.0000000000 1 0 0 1 0 0 0
1403636582863555584.0000000000 1 0 0 {H} 0 0 {H}
"""
EUROC_CSV = "#timestamp, p_RS_R_x [m], ..., b_a_RS_S_z [m s^-2]\n" + "".join(
    line.replace(".0000000000", "").replace(" ", ",") + ",1,2,3,4,5,6,7,8,9\n" for line in EUROC.split("\n")[1:4]
)
KITTI = "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 1 0 1 0 0 0 0 1 0\n0 -1 0 1 1 0 0 0 0 0 1 0\n"
KITTI_TIMES = "0.000000e+00\n1.000000e+00\n2.000000e+00\n"
REPEATED = TUM.replace("101 1", "101 9 9 9 0 0 0 1\n101 1")
"""Of two poses with one time the last counts."""
UPRIGHT = [0.0, 0, 0, 1]
PATHS = [("tum", TUM), ("tum", REPEATED), ("euroc", EUROC), ("euroc", EUROC_CSV), ("kitti", KITTI)]


@pytest.mark.parametrize(("format", "text"), PATHS)
def test_one_path_in_each_format(tmp_path: Path, format: str, text: str) -> None:
    path = written(tmp_path, text, "path.txt")
    written(tmp_path, KITTI_TIMES, "path_times.txt")
    motion = read_motion(path)
    assert motion.time_us.tolist() == [0, 1_000_000, 2_000_000]
    assert motion.coordinate == pytest.approx([0.0, 0.5, 2.0])
    assert (motion.name, motion.gaps) == ("path", ()) and f"format {format}" in motion.source
    assert read_motion(path, MotionSettings(fov_deg=90, scene_scale_m=4)).coordinate == pytest.approx([0, 0.25, 1.25])
    gappy = read_motion(path, MotionSettings(max_gap_s=0.5))
    assert gappy.gaps == ((0, 1_000_000), (1_000_000, 2_000_000)) and gappy.longest_gap_s == 1.0
    zipped = written(tmp_path, gzip.compress(text.encode()), "path.txt.gz")
    assert read_motion(zipped).coordinate.tolist() == motion.coordinate.tolist()


def test_times_in_ns_are_exact_and_a_file_written_is_read_back(tmp_path: Path) -> None:
    lines = [
        f"1403636580{k:09d} 0 0 0 1 0 0 0" for k in (0, 1_000_000, 2_000_999, 3_055_584)
    ]  # as floats known to 256 ns only
    poses = read_poses(written(tmp_path, "# timestamp[ns] px py pz qw qx qy qz\n" + "\n".join(lines), "path.txt"))
    assert poses.time_us.tolist() == [0, 1000, 2000, 3055]
    motion = Motion("m", np.array([0, 1, 1_500_000]), np.array([0.0, 1 / 3, 2e5 / 7]))
    write_motion_csv(motion, tmp_path / "m.csv")
    again = read_motion(tmp_path / "m.csv")
    assert again.name == "m" and again.time_us.tolist() == motion.time_us.tolist()
    assert again.coordinate.tolist() == motion.coordinate.tolist()
    refuse("cannot be written", write_motion_csv, motion, tmp_path, kind=TraceError)


@pytest.mark.parametrize("block_bytes", [7, 40, 2**20])
def test_blocks_of_any_size_give_the_same_coordinates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block_bytes: int
) -> None:
    """Two coordinates of one time, of which the last counts; the last lines break a rule, one in each file."""
    sound = "# by hand\nt_s,motion\n0,0.1\n.1,.30\n+1e-1,0.4\n0.7000005,1.25\n2,1.25\n"
    sources = [
        f"{sound}{end}" for end in ("", "3,1.2\n", "1,2\n", "3,4,5\n", "3\n", "\n\n3,nan\n", "3,2e9\n", "-1,2\n")
    ]
    files = [written(tmp_path, text, f"{k}.csv") for k, text in enumerate(sources)]

    def read(path: Path) -> list[object]:
        try:
            motion = read_motion(path)
        except TraceError as error:
            return [str(error)]
        return [motion.time_us.tolist(), motion.coordinate.tolist(), motion.source]

    blocks = [read(path) for path in files]
    monkeypatch.setattr("bufgym.traces.formats.text._BLOCK_BYTES", block_bytes)
    assert blocks == [read(path) for path in files]
    assert blocks[0][:2] == [[0, 100_000, 700_000, 2_000_000], [0, 0.4 - 0.1, 1.25 - 0.1, 1.25 - 0.1]]
    assert all(", line 8" in str(fault) or ", line 10" in str(fault) for (fault,) in blocks[1:])


def test_kitti_times_from_elsewhere(tmp_path: Path) -> None:
    path = written(tmp_path, KITTI, "00.txt")
    refuse(r"holds KITTI matrices, which carry no time: .*no 00_times.txt beside", read_motion, path, kind=TraceError)
    times = written(tmp_path, KITTI_TIMES, "times.txt")
    assert read_motion(path, times=times).total == pytest.approx(2.0)
    for text, says in (
        ("0\n1\n", r"00.txt, line 3: must have a time, but .*times.txt has no more"),
        (KITTI_TIMES + "3\n", "holds more times than .*00.txt has poses"),
        ("0\n0.2\n0.1\n", r"00.txt, line 3: time in s = 0.1: must not be before the line above"),
    ):
        times.write_text(text)
        refuse(says, read_motion, path, times=times, kind=TraceError)
    refuse("format = 'bvh': must be one of tum, euroc, kitti", read_motion, path, format="bvh")
    refuse(r"times = .*: goes with KITTI matrices only", read_motion, written(tmp_path, TUM, "path.txt"), times=times)


def test_broken_files(tmp_path: Path) -> None:
    written(tmp_path, KITTI_TIMES, "path_times.txt")
    for text, says in (
        ("0 0 0 0 0 0 0 1\n", "must hold at least 2 poses of different times, has 1"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 0\n", "line 2: norm of the quaternion = 0: must be 1 within 1 %"),
        ("0 0 0 1e8 0 0 0 1\n", "line 1: tz = 1e8: must be from -1e\\+07 to 1e\\+07"),
        (
            "0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n2e7 0 0 0 0 0 0 1\n",
            "line 4: time in s = 2e7: must be at most 10000000 s after",
        ),
        ("t_s,motion\n0,0\n1,2\n2,1.5\n", "line 4: motion = 1.5: must not be below the line above"),
        (
            "#timestamp [ns] ...\n1 0 0 0 1 0 0\n",
            r"line 2: '1 0 0 0 1 0 0': must have 8 columns .or 11 or 17 of a state",
        ),
        ("1 0 0 0 0 1 0 0 0 0 2 0\n", "must be a rotation within 1 %"),
        # A reflection: orthogonal, but no rotation.
        ("1 0 0 0 0 1 0 0 0 0 -1 0\n", "must be a rotation within 1 %"),
        ("1403636579763555584 0 0 0 0 0 0 1\n", "line 1: time in s = 1403636579763555584: must be from 0 to"),
    ):
        refuse(says, read_motion, written(tmp_path, text, "path.txt"), kind=TraceError)


def about(axis: tuple[float, float, float], degrees: float) -> np.ndarray:
    half = math.radians(degrees) / 2
    return np.array([*(math.sin(half) * np.array(axis) / np.linalg.norm(axis)), math.cos(half)])


def test_small_angles_are_not_lost_and_a_negative_quaternion_is_no_turn() -> None:
    end = about((0, 0, 1), math.degrees(1e-7))
    for quaternion in (end, -end):
        poses = Poses(np.array([0, 1_000_000]), np.zeros((2, 3)), np.array([UPRIGHT, quaternion]))
        assert motion_from_poses(poses, MotionSettings(fov_deg=math.degrees(1))).total == pytest.approx(1e-7, rel=1e-6)


def test_fast_poses_are_resampled_so_that_jitter_is_not_motion() -> None:
    """A mocap at 300 Hz that stands still and jitters by 0.2 mm: the camera at 30 Hz sees a tenth of it."""
    time_us = np.rint(np.arange(3001) * (1e6 / 300)).astype(np.int64)
    position = np.zeros((3001, 3))
    position[:, 0] = 2e-4 * (np.arange(3001) % 3 == 1)
    poses = Poses(time_us, position, np.tile(UPRIGHT, (3001, 1)))
    every, camera = motion_from_poses(poses, MotionSettings(rate_hz=1000)), motion_from_poses(poses)
    assert every.time_us.size == 3001 and camera.time_us.size == 301
    assert every.total == pytest.approx(2000 * 2e-4 / 2) and camera.total < every.total / 5
    # A steady turn stays steady: once a second about z, given at 100 Hz; at 30 Hz each step is 12 degrees.
    time_us = np.arange(101, dtype=np.int64) * 10_000
    turn = np.stack([about((0, 0, 1), 360 * t / 1e6) for t in time_us.tolist()])
    motion = motion_from_poses(Poses(time_us, np.zeros((101, 3)), turn), MotionSettings(rate_hz=30))
    assert np.diff(motion.coordinate) == pytest.approx(np.full(30, 12 / 60), rel=1e-3)


def test_gaps_are_reported_and_past_the_end_the_total_is_carried_on() -> None:
    time_us = np.array([0, 500_000, 3_000_000, 3_500_000])
    position = np.array([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0]])
    gappy = motion_from_poses(Poses(time_us, position, np.tile(UPRIGHT, (4, 1))))
    assert gappy.gaps == ((500_000, 3_000_000),) and gappy.at(1_750_000) == pytest.approx(0.25)
    motion = Motion("m", np.array([0, 10, 20]), np.array([0.0, 1.0, 1.5]))
    assert motion.at([0, 5, 10, 20, 25, 45]).tolist() == [0.0, 0.5, 1.0, 1.5, 2.0, 3.5]


def test_broken_arguments() -> None:
    time_us = np.array([0, 1, 2])
    for x, says in (([0.0, 1.0, 0.5], "must not decrease at index 2"), ([0.0, math.nan, 1], "finite")):
        refuse(says, Motion, "m", time_us, np.array(x))
    refuse("must increase at index 1", Motion, "m", np.array([0, 0]), np.array([0.0, 1.0]))
    refuse("time_us = -1: must be >= 0", Motion("m", time_us, np.array([0.0, 1.0, 1.0])).at, -1)
    for name in ("fov_deg", "scene_scale_m", "rate_hz", "max_gap_s"):
        refuse(f"{name} = 0.0: must be a finite", MotionSettings, **{name: 0.0})


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
    # Poses between poses.
    quaternion = np.stack([about((0, 0, 1), degrees) for degrees in (0, 100, 100)])
    poses = Poses(np.array([0, 2_000_000, 3_000_000]), np.array([[0.0, 0, 0], [4, 0, 0], [4, 2, 0]]), quaternion)
    between = poses.at(np.array([0, 500_000, 2_500_000, 3_000_000]))
    assert between.position_m.tolist() == [[0, 0, 0], [1, 0, 0], [4, 1, 0], [4, 2, 0]]
    turned = np.degrees(angles(between.quaternion, quaternion[[0]].repeat(4, axis=0)))
    assert turned == pytest.approx([0, 25, 100, 100], abs=1e-6)


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: math.hypot(*q) > 0.1))
def test_matrices_to_quaternions_and_back(numbers: tuple[float, float, float, float]) -> None:
    x, y, z, w = expected = np.array(numbers) / math.hypot(*numbers)
    matrix = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    computed = quaternions(np.array([matrix]))[0]
    assert rotations(expected[None])[0] == pytest.approx(np.array(matrix))
    assert min(np.abs(computed - expected).max(), np.abs(computed + expected).max()) < 1e-12


def test_real_kitti() -> None:
    """Sequence 00 is 3.7 km long, 4541 poses in 470.6 s; its times come from the file beside."""
    (path,) = fetched("kitti-00").glob("KITTI_00_gt.txt*")
    motion = read_motion(path, MotionSettings(fov_deg=1e9, scene_scale_m=1))
    assert motion.total == pytest.approx(3724, abs=1) and (motion.time_us.size, motion.gaps) == (4541, ())
    assert motion.duration_us / 1e6 == pytest.approx(470.6, abs=0.1)
    assert "times from KITTI_00_gt_times.txt" in motion.source
