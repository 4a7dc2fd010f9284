"""Times in a unit that a file does not name, and samples that share a time."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from link_files import written
from recording_cases import ODD_FILES
from refusal_cases import refuse

from bufgym.traces import read_motion
from bufgym.traces.formats.trajectories import read_poses
from bufgym.utils.errors import TraceError, TraceWarning

PER_S = {"ns": 10**9, "us": 10**6, "ms": 10**3}


def since_boot(unit: str, days: float, rate_hz: int, separator: str = ",", decimals: int = 0) -> str:
    """300 poses, 1 cm from one to the next."""
    start, lines = round(days * 86_400 * PER_S[unit]), []
    for k in range(300):
        time = start + k * PER_S[unit] / rate_hz
        text = f"{time:.{decimals}f}" if unit == "ms" else f"{start + k * PER_S[unit] // rate_hz}"
        lines.append(separator.join([text, f"{0.01 * k:.2f}", "0", "0", "1", "0", "0", "0"]))
    return "\n".join(lines)


@pytest.mark.parametrize("header", [True, False], ids=["header", "no header"])
@pytest.mark.parametrize("unit", PER_S)
@pytest.mark.parametrize("rate_hz", [30, 200, 1000])
@pytest.mark.parametrize("days", [1, 2, 6.9, 7, 8.1, 10, 12, 19.7, 33, 48.6, 60])
@pytest.mark.filterwarnings("ignore:.*times are taken as times in .* since a start:bufgym.utils.errors.TraceWarning")
def test_times_since_a_boot_have_their_length_or_are_asked_about(
    tmp_path: Path, days: float, rate_hz: int, unit: str, header: bool
) -> None:
    """300 poses last for 299 steps. With a header they always do; without, some may be dates."""
    for separator, decimals in ((",", 0), (" ", 0), (",", 3), (" ", 3)):
        text = since_boot(unit, days, rate_hz, separator, decimals)
        path = written(tmp_path, f"#timestamp [{unit}]\n{text}" if header else text, "path.csv")
        try:
            poses = read_poses(path)
        except TraceError as error:
            assert not header and "median step of the times" in str(error) and "may be of dates in" in str(error)
            assert 10.8 < days < 33
        else:
            # Whole ms at 30 Hz are off by at most one.
            assert poses.time_us[-1] == pytest.approx(299 * 1e6 / rate_hz, abs=1001), poses.format


def test_phones_of_8_days(tmp_path: Path) -> None:
    for name, steps, rate_hz, x in (("boot_1khz.csv", 2999, 1000, 1.4995), ("phone_8d1_nohead.csv", 299, 30, 2.99)):
        motion = read_motion(ODD_FILES / name)
        assert motion.duration_us == pytest.approx(steps * 1e6 / rate_hz, abs=1)
        assert motion.total == pytest.approx(x)


def test_which_of_two_units_is_said(tmp_path: Path) -> None:
    """12 days since the boot are 2002 in the unit above. Steps of 33 s are gaps; 1 s may be meant."""
    path = written(tmp_path, since_boot("ns", 12, 30), "path.csv")
    says = r"times are taken as times in ns since a start \(12.0 days before, 30 poses a second\), not as dates in us"
    with pytest.warns(TraceWarning, match=says):
        read_poses(path)
    path = written(tmp_path, since_boot("ns", 12, 1000), "path.csv")
    says = (
        r"may be of dates in us \(2003, 1 s from pose to pose\) or of times in ns since a start .*'#timestamp \[ns\]'"
    )
    refuse(says, read_poses, path, kind=TraceError)
    assert read_poses(path, format="euroc").time_us[-1] == 299_000
    # TUM's seconds with their usual decimals are seconds, however far apart.
    lines = "".join(f"{1403638522.8 + 3 * k:.6f} 0 0 0 0 0 0 1\n" for k in range(9))
    assert read_poses(written(tmp_path, lines, "path.txt")).time_us[-1] == 24_000_000
    ask = "".join(f"{1403638522 + 3 * k} 0 0 0 0 0 0 1\n" for k in range(9))
    refuse(r"or of times in ms since a start", read_poses, written(tmp_path, ask, "path.txt"), kind=TraceError)


def test_a_header_that_names_another_unit_and_frame_numbers_are_warned_of(tmp_path: Path) -> None:
    text = "#timestamp [us]\n" + since_boot("ns", 3, 200)
    with pytest.warns(
        TraceWarning, match="header says that times are in us, which makes 5 s .*, where ns make 0.005 s"
    ):
        read_poses(written(tmp_path, text, "path.csv"))
    frames = "".join(f"{k} 0 0 0 0 0 0 1\n" for k in range(7, 20))
    with pytest.warns(TraceWarning, match=r"times 7, 8, 9, ... look like frame numbers: they are taken as seconds"):
        assert read_poses(written(tmp_path, frames, "path.txt")).time_us[-1] == 12_000_000
    slow = "t_s,motion\n" + "".join(f"{33 * k},{k}\n" for k in range(9))
    with pytest.warns(TraceWarning, match="its samples are 33 s apart .median.: are the times in another unit"):
        read_motion(written(tmp_path, slow, "m.csv"))


def test_poses_that_share_a_time_are_counted(tmp_path: Path) -> None:
    """Ten poses in each of 30 seconds: nine of ten are left out. Digits that end at 10,000 s: all but one are."""
    says = "left out 270 of 300 poses that share a time with a later one, the first in line 1, at most 10 of one time"
    with pytest.warns(TraceWarning, match=says):
        read_motion(ODD_FILES / "tum_1s_rock.txt")
    refuse("line 1: 300 poses of one time: must have", read_motion, ODD_FILES / "tum_6digits.txt", kind=TraceError)
    # One in a hundred is no more than a coarse digit: a note. Ten of one time are more.
    times = [0.1 * k for k in range(100)]
    for repeated, warned in (([7], False), ([7, 7], False), ([7] * 9, True), ([7, 20, 33, 50, 61, 80], True)):
        at = sorted(times + [times[k] for k in repeated])
        text = "# t x y z\n" + "".join(f"{time:.1f} 0 0 0 0 0 0 1\n" for time in at)
        path = written(tmp_path, text, "path.txt")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            source = read_motion(path).source
        said = f"left out {len(repeated)} of {len(at)} poses that share a time with a later one"
        assert [said in str(one.message) for one in caught] == [True] * warned
        assert (said in source) != warned
        if warned:
            assert f"the first in line {9}," in str(caught[0].message)  # below the header, 0.7 s


def test_a_block_of_numbers_and_its_lines_are_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks of some lines, of which one has a remark in it; poses of one time on both sides of a block's edge."""
    rng = np.random.default_rng(5)
    monkeypatch.setattr("bufgym.traces.formats.text._BLOCK_BYTES", 512)
    for unit, separator in (("s", " "), ("s", ","), ("ns", ","), ("ms", " ")):
        lines, time_us = [], 1_700_000_000_000_000
        for _ in range(300):
            time_us += int(rng.integers(0, 3)) * 16_667
            time = f"{time_us / 1e6:.6f}" if unit == "s" else str(time_us * PER_S[unit] // 10**6)
            turn = rng.normal(size=4)
            turn /= np.linalg.norm(turn)
            lines.append(separator.join([time, *map(repr, rng.normal(size=3).tolist()), *map(repr, turn.tolist())]))
        text = "\n".join([*lines[:150], "# a remark", *lines[150:]]) + "\n"
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            blocks = read_poses(written(tmp_path, text, "path.txt"))
            # White space of other scripts is read line by line.
            plain = read_poses(written(tmp_path, text.replace("\n", "\u2003\n"), "path.txt"))
        assert blocks.time_us.tolist() == plain.time_us.tolist()
        assert blocks.position_m.tolist() == plain.position_m.tolist()
        assert blocks.quaternion.tolist() == plain.quaternion.tolist()
        left_out = [str(one.message) for one in caught if "left out" in str(one.message)]
        assert len(left_out) == 2 and left_out[0] == left_out[1]
        bad = text.replace(lines[200], lines[200].replace(separator, separator + "x", 1))
        refuse("path.txt, line 202: tx|px = x", read_poses, written(tmp_path, bad, "path.txt"), kind=TraceError)
