"""The door to the figures: names, options, files."""

import csv
import re
import sys
from pathlib import Path
from typing import Any

import pytest
from cli_cases import Capsys, Patch, fails
from refusal_cases import refuse

from bufgym.cli import main
from bufgym.ground.kernel import JIT
from bufgym.papers import FIGURES, afr_fig5, page, run
from bufgym.papers.figure import statements
from bufgym.papers.page import claim_rows

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

CLAIMS = Path(__file__).parent.parent.parent / "docs" / "claims.md"
SLOW = {"afr-qoi-task", "afr-fig7", "afr-fig9", "robofleet-table2"}


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.nightly] * (n in SLOW)) for n in FIGURES])
def test_saves_its_numbers_and_its_figure(name: str, tmp_path: Path, monkeypatch: Patch) -> None:
    for library in ("matplotlib", *NEEDS_LIBRARIES.get(name, ())):
        pytest.importorskip(library)
    if not JIT and name in OF_FRAMES:
        pytest.skip("without compilation a room takes minutes to draw")
    monkeypatch.setattr(afr_fig5, "MEAN_OVER", (9, 40 if JIT else 20))
    text = run(name, tmp_path / "new", **SMALL[name])
    assert "paper" in text
    table = tmp_path / "new" / f"{name}.csv"
    figure = tmp_path / "new" / f"{name}.png"
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
        assert len(re.findall(f"`{name}`( †)? \\|", text_of_page)) == len(texts["claims"])
    if texts.get("fast"):
        for library in NEEDS_LIBRARIES.get(name, ()):
            pytest.importorskip(library)
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


def test_what_is_cited_is_in_the_references() -> None:
    keys = set(re.findall(r"^@\w+\{(\w+),", (CLAIMS.parent / "references.bib").read_text(encoding="utf-8"), re.M))
    texts = [CLAIMS, *(CLAIMS.parent.parent / "bufgym" / "papers").glob("*.py")]
    cited = {key for path in texts for key in re.findall(r"\[([a-z]+20\d\d\w+)\]", path.read_text(encoding="utf-8"))}
    assert {"wang2022afr", "sikand2021robofleet", "vanderhooft2016http2"} <= cited <= keys


def test_unknown_names_and_unusable_options_are_refused() -> None:
    for name, options, says in (
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
