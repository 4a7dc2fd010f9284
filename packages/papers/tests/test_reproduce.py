"""The door to the figures: names, options, files."""

import csv
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import frame_cases
import numpy as np
import pytest
from cli_cases import Capsys, Patch, fails
from needs import needs
from refusal_cases import refuse

from bufgym.benchmark.bootstrap import Interval
from bufgym.cli import main
from bufgym.jit import JIT
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError
from bufgym.utils.libraries import library
from bufgym_papers.figures import FIGURES, afr_fig5, afr_fig7, afr_fig8, frame_tasks, page, run
from bufgym_papers.figures.figure import UNDECIDED, about, of_all, statements, within
from bufgym_papers.figures.frame_runs import spearman
from bufgym_papers.figures.frame_tasks import FrameTask, carry_out
from bufgym_papers.figures.page import claim_rows
from bufgym_papers.figures.rows import FigureRows
from bufgym_papers.perception.frames import Camera, encoded_bytes
from bufgym_papers.perception.recordings import open_sequence

LTE = {"trace": "lte-synthetic-0"}
SHORT: dict[str, Any] = {**LTE, "frames": 40, "capacities": (2, 4), "runs": 2, "sweep_kb": (500,)}
FRAMES: dict[str, Any] = {"frames": 40, "capacities": (2,), "policies": ("drop-oldest", "afr"), "offsets": 2, "jobs": 1}
SMALL: dict[str, dict[str, Any]] = {
    **{name: {} for name in ("afr-fig2", "afr-fig3", "afr-fig4", "afr-queue", "afr-views")},
    "afr-model": {"runs": 200 if JIT else 20},
    "afr-fig1": {"frames": 40, "offsets": 1, "jobs": 1},
    "afr-fig5": {"runs": 50 if JIT else 3, "last_T": 40 if JIT else 18},
    "afr-fig6": LTE,
    "afr-frame-size": SHORT,
    "afr-vs-random": {"max_capacity": 8, "last_T": 20},
    "afr-theorems": {"max_capacity": 4, "last_T": 40},
    "afr-fig9": {"decisions": 1000, "calls": 100, "images": 3 if JIT else 0},
    "afr-fig7": FRAMES,
    "afr-fig8": FRAMES,
    "afr-overlap": {**FRAMES, "capacity": 2, "distances": (1, 4, 8), "motions": (0.05, 0.1)},
    "afr-qoi-task": {**FRAMES, "offsets": 3},
    "robofleet-table1": {"points": 50},
    "robofleet-table2": {"points": 50, "runs": 2, "seconds": 0.5},
    "robofleet-fig3": {"rates_hz": (5, 100), "duration_s": 0.5, "runs": 1},
    "robofleet-fig4": {"dropouts_s": (1,), "links_mbit_per_s": (100,), "kinds": ("CompressedImage",), "runs": 2},
    "robofleet-fig5": {"fall_s": 3, "stay_s": 1, "runs": 1},
    "robofleet-fig6": {"points": (100,), "max_consumers": 2, "duration_s": 2, "runs": 1},
    "robofleet-fig7": {"bad_from": 10, "bad_s": 2, "after_s": 1, "bad_mbit_per_s": (1,), "runs": 1},
}
"""Options that keep each figure short; a new figure must add its own."""

OF_FRAMES = [name for name, options in SMALL.items() if "offsets" in options]
NEEDS_LIBRARIES = {
    "robofleet-table1": ("rosbags", "flatbuffers"),
    "robofleet-table2": ("rosbags", "flatbuffers", "roslibpy", "websockets"),
    **dict.fromkeys(OF_FRAMES, ("cv2", "rvl", "scipy")),
}

CLAIMS = Path(__file__).resolve().parents[3] / "results" / "claims.md"
SLOW = {"afr-qoi-task", "afr-fig7", "afr-fig9", "robofleet-table2"}


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.nightly] * (n in SLOW)) for n in SMALL])
def test_saves_its_numbers_and_its_figure(name: str, tmp_path: Path, monkeypatch: Patch) -> None:
    for package in ("matplotlib", *NEEDS_LIBRARIES.get(name, ())):
        pytest.importorskip(package, reason=needs("extras", package))
    if not JIT and name in OF_FRAMES:
        pytest.skip(needs("compiled", "a room takes minutes to draw"))
    monkeypatch.setattr(afr_fig5, "MEAN_OVER", (9, 40 if JIT else 20))
    text = run(name, tmp_path / "new", **SMALL[name])
    assert "paper" in text
    table, figure = (tmp_path / "new" / f"{name}.{kind}" for kind in ("csv", "png"))
    assert str(table) in text and str(figure) in text
    with table.open(newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    assert len(rows) >= 3 and all(len(row) == len(header) for row in rows)
    assert figure.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")


def test_without_a_folder_nothing_is_saved_without_matplotlib_numbers_are(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.chdir(tmp_path)
    assert "Fig. 4" in run("afr-fig4") and list(tmp_path.iterdir()) == []
    for name in ("matplotlib.figure", "matplotlib.backends.backend_agg"):
        monkeypatch.setitem(sys.modules, name, None)  # None there makes the import fail
    text = run("afr-fig4", tmp_path)
    assert "10 of 10 drops" in text and "bufgym[plot]" in text
    assert [path.name for path in tmp_path.iterdir()] == ["afr-fig4.csv"]


@pytest.mark.parametrize("name", statements())
def test_every_claim_has_its_place_or_is_ours_and_a_row_on_the_page(name: str) -> None:
    texts, text_of_page = statements()[name], CLAIMS.read_text(encoding="utf-8")
    assert "title" in texts or name.endswith("-other")
    for claim, text in texts["claims"].items():
        assert {"says", "ours"} <= set(text) and bool(text.get("own")) != ("place" in text), claim
    if name in FIGURES:
        assert name in SMALL or name == "afr-roscpp"  # which has a test in studies/
        assert len(re.findall(f"`{name}`( †)? \\|", text_of_page)) == len(texts["claims"])
    if texts.get("fast"):
        for library in NEEDS_LIBRARIES.get(name, ()):
            pytest.importorskip(library, reason=needs("extras", library))
        assert set(claim_rows(name)) <= set(text_of_page.splitlines())  # what comes out now


def test_the_rows_of_one_figure_are_renewed(tmp_path: Path, monkeypatch: Patch, capsys: Capsys) -> None:
    """Fig. 4's row is made again, and those of figures that are not named stay, however old."""
    file, old = tmp_path / "claims.md", "| place | an old sentence | `{}` | ours | not checked | |"
    file.write_text("\n".join(["# Head", "", old.format("afr-fig4").replace("4`", "4` †"), old.format("afr-fig5")]))
    command = ["reproduce", "afr-fig4", "--claims", str(file), "--out", str(tmp_path / "out")]
    assert main(command) == 0
    assert file.read_text().splitlines() == ["# Head", "", *claim_rows("afr-fig4"), old.format("afr-fig5")]
    assert main(["reproduce", "afr-fig6", *command[2:]]) == 2
    assert "figure afr-fig6: no row of it in the page of claims" in capsys.readouterr().err
    # The whole page leaves out what cannot be made; a page that cannot be written stays as it was.
    monkeypatch.setattr(page, "statements", lambda: {name: statements()[name] for name in ("afr-fig4", "afr-fig6")})
    assert main(["reproduce", "--claims", str(file)]) == 0
    for said in ("| 10 of 10 drops as in the paper. | holds |", "(--data DIR)", "| not checked |"):
        assert said in file.read_text(encoding="utf-8")
    file.write_text("what was known")
    monkeypatch.setattr(page, "claims_page", lambda data, out: "new, and no text \udc80")
    with pytest.raises(UnicodeEncodeError):
        main(["reproduce", "--claims", str(file)])
    assert file.read_text() == "what was known"
    command = ["reproduce", "robofleet-fig3", "--live", "--claims", str(file)]
    fails(command, "--live: not with --claims, whose numbers are simulated", capsys)
    says = "afr-fig4: is not played on sockets; robofleet-fig3 to robofleet-fig7 are"
    fails(["reproduce", "afr-fig4", "--live", "--out", str(tmp_path)], says, capsys)


def test_unknown_names_and_unusable_options_are_refused() -> None:
    for name, options, says in (
        ("afr-fig55", {}, "unknown figure 'afr-fig55'; did you mean 'afr-fig5'"),
        ("afr-fig5", {"rums": 3}, "afr-fig5: unknown option 'rums'; did you mean 'runs'"),
        ("afr-fig5", {"runs": 0}, "must be|need"),
        ("afr-views", {"turn_degrees": 0}, "must be|need"),
        ("afr-vs-random", {"last_T": 3}, "must be|need"),
        ("afr-fig6", LTE | {"size_bytes": 0}, "size_bytes = 0"),
        *((f"robofleet-fig{k}", {"runs": 0}, "runs = 0: must be a whole number >= 1") for k in range(3, 8)),
        *((f"robofleet-fig{k}", {"round_trip_ms": -1}, "round_trip_ms = -1: must be a n") for k in range(3, 8)),
        ("robofleet-fig4", {"kinds": ("Laser",)}, "must be some of PointCloud2, CompressedImage, LaserScan"),
        ("robofleet-fig6", {"queue_sizes": (1.5,)}, "queue_sizes = 1.5: must be a whole number >= 1"),
    ):
        refuse(says, run, name, **options)


# Recordings of depth cameras: read as they were written, and one clear error for each way in which they are broken.

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
    refuse(r"bufgym needs rvl: pip install .*perception", library, "rvl", "bufgym-papers[perception]")


def test_the_size_of_a_frame() -> None:
    # An even wall costs a nibble for each of 307 200 pixels, 150 kB; where nothing was measured, nearly none.
    grey = np.full((480, 640), 90, np.uint8)
    picture = len(library("cv2", "bufgym-papers[perception]").imencode(".jpg", grey, [1, 50])[1])
    wall = encoded_bytes(np.full((480, 640), 1.5, np.float32), grey)
    assert 0 <= wall - picture - 640 * 480 // 2 < 32
    assert encoded_bytes(np.zeros((480, 640), np.float32), grey) - picture < 32
    # Half a frame is doubled before.
    assert encoded_bytes(np.full((240, 320), 1.5, np.float32), grey[::2, ::2]) == wall


# Figures on frames that are mapped and tracked: tasks that are kept, the sweep, what the texts say of the numbers.

LINK = Trace.constant(1e6, 10.0, name="link")


def test_what_is_finished_is_not_done_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Equal tasks are done once, wherever the data lie; a map or track is of its frames, whatever the policy was."""
    asked: list[tuple[int, ...]] = []

    class Counted:
        def mapped(self, about: tuple[int, ...]) -> dict[str, float]:
            asked.append(about)
            return {"rmse_mm": float(len(about))}

    monkeypatch.setattr(frame_tasks, "stage", lambda *place: Counted())
    one, two, three = (FrameTask("map", "room", 40, kept) for kept in ((0, 1), (0, 1, 2), (0, 5, 6)))
    found = carry_out([one, one, two], None, LINK, tmp_path, 1)
    assert found == {one: {"rmse_mm": 2.0}, two: {"rmse_mm": 3.0}} and len(asked) == 2
    assert carry_out([one, three], "elsewhere", LINK, tmp_path, 1)[one] == {"rmse_mm": 2.0}
    assert asked[2:] == [(0, 5, 6)]


def test_spearman() -> None:
    a = np.array([1.0, 2, 3, 4])
    assert spearman(a, np.exp(a)) == pytest.approx(1)
    assert spearman(a, np.array([4.0, 3, 1, 2])) == pytest.approx(-0.8)  # 1 - 6 (9 + 1 + 4 + 4) / (4 x 15)
    assert np.isnan(spearman(a, np.ones(4)))
    # AFR is 10 % below at every place of the fade, however much these differ: the interval has no width.
    pairs = [("drop-oldest", 10.0), ("afr", 9.0)]
    rows = FigureRows({"k": k, "L": 5, "policy": p, "rmse_mm": mm * (1 + k)} for k in range(4) for p, mm in pairs)
    assert afr_fig7.spelled(afr_fig7.change(rows, "rmse_mm", "afr", "drop-oldest")) == "-10.0% [-10.0%, -10.0%]"


def fig8_claims(broken: dict[tuple[str, str, int], int], data: Path | None, *capacities: int) -> dict[str, Any]:
    """Claims where of ten runs so many fail: by recording, policy and L; none where nothing is said."""
    policies = ("drop-oldest", "afr")
    rows = FigureRows(
        {"recording": r, "k": k, "L": L, "policy": p, "failed": k < broken.get((r, p, L), 0), "failed_at": None}
        for r in ("room", "7-scenes")[: 1 + (data is not None)]
        for p in policies
        for L in capacities
        for k in range(10)
    )
    return afr_fig8.Reproduction(policies=policies, capacities=capacities, data=data).claims(rows)


def test_the_claims_of_fig8_count_failures(tmp_path: Path) -> None:
    """Of ten runs at each of two L Drop Oldest breaks 6 and AFR 2, at L = 5 alone."""
    broken = {("room", "drop-oldest", 5): 4, ("room", "drop-oldest", 15): 2, ("room", "afr", 5): 2}
    facts = fig8_claims(broken, None, 5, 15)
    assert facts["counts"] == "room: Drop Oldest 6, AFR 2"
    assert facts["oldest_rate"].startswith("room 30% [") and facts["afr_rate"].startswith("room 10% [")
    assert facts["third_count"] == "room 2 against 6"
    assert facts["third"] and facts["large"]
    assert facts["oldest"] == facts["afr"] == UNDECIDED  # 30 % of the runs, and 10 %, at ten places of the fade
    # A claim holds on every recording: on 7-Scenes AFR breaks one.
    (tmp_path / "rgbd_7scenes").mkdir()
    broken = {("room", "drop-oldest", 5): 5, ("7-scenes", "drop-oldest", 5): 5, ("7-scenes", "afr", 5): 1}
    facts = fig8_claims(broken, tmp_path, 5)
    assert facts["third"] and facts["large"] is None  # no L above 10
    assert facts["afr"] == UNDECIDED and facts["afr_rate"].startswith("room 0% [0%, 0%]; 7-scenes 10% [")


def test_a_claim_holds_where_its_interval_lies_within_it() -> None:
    """An error 10.1 % lower, 8.2 to 12.2 %, is about 10 % and not about 20 %; one of -2 to 23 % is neither."""
    found, wide = Interval(-0.101, -0.122, -0.082), Interval(-0.1, -0.23, 0.02)
    assert [within(found, *about(share)) for share in (-0.1, -0.2)] == [True, False]
    assert [within(wide, *about(share)) for share in (-0.1, -0.2, -0.4)] == [UNDECIDED, UNDECIDED, False]
    assert [of_all(v) for v in ([True, True], [True, UNDECIDED], [UNDECIDED, False], [True, None])] == [
        True, UNDECIDED, False, None,
    ]  # fmt: skip
