"""Learning curves over seeds: means and Student's intervals by hand, and files that are none."""

import math
from pathlib import Path

import pytest
from cli_cases import Capsys, fails, shown
from needs import needs
from refusal_cases import refuse

import bufgym
from bufgym.benchmark.curves import read_curve

pytest.importorskip("matplotlib", reason=needs("extras", "matplotlib"))


def run_of(folder: Path, *seeds: str, file: str = "validation.csv") -> Path:
    """A run with this text in the file of each seed."""
    for k, text in enumerate(seeds):
        (folder / f"seed-{k}").mkdir(parents=True)
        (folder / f"seed-{k}" / file).write_text(text)
    return folder


HEAD = "steps,seconds,loss,score\n"


def test_means_and_intervals_over_seeds_by_hand(tmp_path: Path) -> None:
    """Scores 1 and 3 at 200 steps: mean 2, sd sqrt(2), and t(.95, 1) = 12.706, so 12.706 to either side."""
    run = run_of(tmp_path / "ppo", f"{HEAD}100,1,9,0\n200,2,8,1\n", f"{HEAD}100,1,7,0\n200,2,5,3\n")
    curve = read_curve(run)
    assert (curve.name, curve.measure) == ("ppo", "score") and curve.steps.tolist() == [100, 200]
    assert curve.mean.tolist() == [0, 2] and curve.reach == pytest.approx([0, 12.706], abs=1e-3)
    assert read_curve(run, "loss").mean.tolist() == [8, 6.5]


def test_seeds_are_compared_at_the_steps_that_all_have(tmp_path: Path) -> None:
    """Seed 0 is at 0, 10, 20; seed 1, at 10 and 30, is at 20 half way between 4 and 8."""
    run = run_of(tmp_path / "a", "steps,score\n0,0\n10,2\n20,4\n", "steps,score\n10,4\n30,8\n")
    curve = read_curve(run)
    assert curve.steps.tolist() == [10, 20] and curve.seeds.tolist() == [[2, 4], [4, 6]]


def test_episodes_of_a_monitor_become_means_of_thirty_parts(tmp_path: Path) -> None:
    """60 episodes of 5 steps with returns 0 to 59: parts of two, (0 + 1) / 2 after 10 steps, 58.5 after 300."""
    text = "#{}\nr,l,t\n" + "".join(f"{k},5,{k}\n" for k in range(60))
    curve = read_curve(run_of(tmp_path / "b", text, file="0.monitor.csv"))
    assert curve.measure == "return" and curve.steps.tolist() == [10 * k for k in range(1, 31)]
    assert curve.seeds[0, [0, -1]].tolist() == [0.5, 58.5] and math.isnan(curve.reach[0])  # one seed has no interval


@pytest.mark.parametrize("kind", ["svg", "png", "pdf"])
def test_the_picture_and_the_command(tmp_path: Path, kind: str, capsys: Capsys) -> None:
    run = run_of(tmp_path / "ppo", f"{HEAD}100,1,9,0\n200,2,8,1\n", f"{HEAD}100,1,7,0\n200,2,5,3\n")
    out = tmp_path / f"curves.{kind}"
    said = shown(["curves", str(run), str(run), "--out", str(out)], capsys)
    assert said.splitlines()[:2] == ["ppo: score 2.000 [-10.706, 14.706] after 200 steps"] * 2
    assert out.read_bytes()[:5] == {"svg": b"<?xml", "png": b"\x89PNG\r", "pdf": b"%PDF-"}[kind]


def test_what_cannot_be_drawn_is_named(tmp_path: Path, capsys: Capsys) -> None:
    out = tmp_path / "c.svg"
    refuse("no folders seed-0", bufgym.curves, tmp_path, out)
    fails(["curves", "--out", str(out)], "runs = []: need at least one folder", capsys)
    good = run_of(tmp_path / "good", "steps,score\n1,1\n")
    refuse("must be FILE.svg, .png or .pdf", bufgym.curves, good, tmp_path / "c.txt")
    refuse("unknown measure 'scor'; did you mean 'score'", bufgym.curves, good, out, "scor")
    refuse("no validation.csv and no 0.monitor.csv", bufgym.curves, run_of(tmp_path / "e", "", file="x"), out)
    refuse("numbers alone below its head", bufgym.curves, run_of(tmp_path / "t", "steps,score\n1,a\n"), out)
    refuse("a head and at least one line", bufgym.curves, run_of(tmp_path / "n", "steps,score\n"), out)
    refuse("a column steps, and a measure", bufgym.curves, run_of(tmp_path / "s", "seconds,score\n1,1\n"), out)
    apart = run_of(tmp_path / "apart", "steps,score\n1,1\n", "steps,score\n5,1\n")
    refuse("its seeds have no steps in common", bufgym.curves, apart, out)
    mixed = run_of(tmp_path / "mixed", "steps,score\n1,1\n", "steps,loss\n1,1\n")
    refuse("its seeds have loss and score: must be one measure", bufgym.curves, mixed, out)
    monitor = run_of(tmp_path / "m", "#{}\nr,l,t\n1,5,1\n", file="0.monitor.csv")
    refuse("has the return alone", bufgym.curves, monitor, out, "score")
    assert not out.exists()
