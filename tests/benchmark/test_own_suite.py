"""A suite of one's own: frozen by seeds, the same in each process, resumed after a kill, on a board of one's own."""

import json
import math
from pathlib import Path
from typing import Any

import pytest
from cli_cases import Capsys, Patch, shown
from needs import needs
from refusal_cases import refused
from sweep_cases import contents, ended, interrupt

import bufgym
from bufgym import cli, policies
from bufgym.benchmark import leaderboard, run, sweep
from bufgym.envs import SenderEnv
from bufgym.scenario import Interruption, get, suites
from bufgym.scenario.numbered import numbered
from bufgym.scenario.suites.own import fingerprint

SHORT = "lte:rate_hz=5.0,duration_s=3.0,traces=lte-synthetic-0"
LAB = f"""
import bufgym
LAB = bufgym.suite("lab-v1", {{"slow": "{SHORT}", "fast": "{SHORT},jitter=0.2"}}, capacity=[3, 4], seeds=2, about="Two")
HALF = 0.5
"""


def stubborn(buffer: Any, arrival: Any, memory: Any) -> int:
    """Rejects whatever does not fit."""
    return -2 if len(buffer.slots) < buffer.capacity else -1


def small(**changed: Any) -> suites.Suite:
    given: dict[str, Any] = {"capacity": [2, 3], "seeds": 3, **changed}
    return bufgym.suite("small-v1", {"a": Interruption(t_max=30), "b": "interruption:t_max=60"}, **given)


def test_its_rows_are_those_of_its_seeds_and_splits_share_none() -> None:
    """2 scenarios x 2 capacities x 3 seeds; the test split's seeds count from 600, those of validation from 300."""
    done = bufgym.compare(["afr", stubborn, "drop-oldest"], small(), progress=False)
    chosen = [policies.get("afr"), bufgym.make_policy(stubborn), policies.get("drop-oldest")]
    wanted = []
    for label, scenario in (("a", Interruption(t_max=30)), ("b", Interruption(t_max=60))):
        wanted += run.run(chosen, scenario, [2, 3], [600, 601, 602], label=label)
    assert repr(done.rows) == repr(wanted) and len(wanted) == 2 * 2 * 3 * 3
    others = bufgym.compare("afr", "small-v1", split="validation", progress=False)
    assert {row["seed"] for row in others.rows} == {300, 301, 302}


def test_an_environment_plays_it_by_its_name() -> None:
    small()
    env = SenderEnv("suite", 3, suite="small-v1", split="train", actions="slots")
    env.reset(options={"scenario": "b", "seed": 601})
    episode = env.sub_envs.senders.episodes[0]
    assert episode is not None and episode.last_decision == numbered(Interruption(t_max=60), 601).last_decision


def test_estimates_are_the_tables_numbers_and_latex_has_them() -> None:
    done = bufgym.compare(["afr", "min-gap"], small(), against="afr", progress=False)
    (score,) = (e for e in done.estimates if (e["policy"], e["scenario"], e["quantity"]) == ("afr", "all", "score"))
    assert score["low"] < score["estimate"] < score["high"] and score["capacity"] is None
    shown_as = "{estimate:.3f} [{low:.3f}, {high:.3f}]".format(**score)
    assert shown_as in done.table() and shown_as in done.table("latex")
    cells = [e for e in done.estimates if e["policy"] == "afr" and e["quantity"] == "qoi"]
    assert [(e["scenario"], e["capacity"]) for e in cells] == [("a", 2), ("a", 3), ("b", 2), ("b", 3)]
    own = [row["qoi"] for row in done.rows if (row["policy"], row["scenario"], row["capacity"]) == ("afr", "b", 3)]
    assert cells[-1]["estimate"] == pytest.approx(math.fsum(own) / 3)
    latex = done.table("latex").split("\n")
    assert latex[0] == r"\begin{tabular}{llrrrrrr}" and latex[1] == r"\toprule" and r"\%" in latex[4]
    assert all(line.endswith(r"\\") and line.count(" & ") == 7 for line in (latex[2], *latex[4:7]))


def test_a_frame_of_estimates() -> None:
    pytest.importorskip("pandas", reason=needs("extras", "pandas"))
    frame = bufgym.compare("afr", "interruption", seeds=2, progress=False).to_pandas("estimates")
    assert [*frame] == ["policy", "scenario", "capacity", "quantity", "estimate", "low", "high"]


def test_a_run_in_processes_is_resumed_and_never_mixed(tmp_path: Path, monkeypatch: Patch, capsys: Capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lab.py").write_text(LAB)
    words = ["bench", "--suite", "lab:LAB", "--policies", "afr,drop-oldest", "--format", "csv", "--out", "out"]
    whole = sweep.run_shard

    def one_then_stop(shard: sweep.Shard) -> list[Any]:
        return whole(shard) if shard.label == "slow" else interrupt()

    with monkeypatch.context() as cut:
        cut.setattr(sweep, "run_shard", one_then_stop)
        assert cli.main([*words, "--jobs", "1"]) == 130
    assert "the same command resumes it" in capsys.readouterr().err
    assert [file.name for file in Path("out/parts").iterdir()] == ["slow-0-600.csv"]
    code, said, complaint = ended(*words, "--jobs", "2")
    assert code == 0 and "16 rows in out" in said, complaint
    before = contents(Path("out"))
    assert "16 rows in out" in shown([*words, "--jobs", "1"], capsys) and contents(Path("out")) == before
    Path("lab.py").write_text(LAB.replace("jitter=0.2", "jitter=0.3"))
    code, _, complaint = ended(*words, "--jobs", "1")
    assert code == 2 and "scenarios is" in complaint and "finished rows are never mixed" in complaint


def test_a_policy_of_this_process_is_kept_apart_by_what_it_is_made_of(tmp_path: Path) -> None:
    lab = small(seeds=1)
    bufgym.compare(stubborn, lab, out=tmp_path / "out", progress=False)
    assert [*json.loads((tmp_path / "out/manifest.json").read_text())["made_of"]] == ["stubborn"]

    def another(buffer: Any, arrival: Any, memory: Any) -> int:
        return -2 if len(buffer.slots) < buffer.capacity else 0

    changed = policies.Policy("stubborn", another)
    with pytest.raises(bufgym.BufgymError, match=r"made_of is .*never mixed"):
        bufgym.compare(changed, lab, out=tmp_path / "out", progress=False)


def test_its_leaderboard_is_made_and_checked(tmp_path: Path, monkeypatch: Patch, capsys: Capsys) -> None:
    monkeypatch.chdir(tmp_path)
    Path("lab.py").write_text(LAB)
    suite = suites.get(suites.named("lab:LAB"))
    assert (suite.source, suite.about, suite.capacities) == ("lab:LAB", "Two", (3, 4))
    leaderboard.make(Path("board.csv"), {suite.name: ["afr", "min-gap"]}, jobs=1)
    row = leaderboard.find(Path("board.csv"), "lab-v1/min-gap")
    assert row.command == "bufgym bench --suite lab:LAB --policies min-gap"
    assert "lab-v1/min-gap: holds" in shown(
        ["validate", "lab:LAB/min-gap", "--file", "board.csv", "--jobs", "1"], capsys
    )


def test_two_scenarios_of_one_text_differ_by_their_episodes() -> None:
    assert fingerprint(get(SHORT)) == fingerprint(get(SHORT)) != fingerprint(get(SHORT, jitter=0.2))


test_what_is_wrong_is_named = refused(
    (lambda: bufgym.suite("lte-v1", "lte"), "suite 'lte-v1': a built-in suite has this name"),
    (lambda: bufgym.suite("my suite", "lte"), "suite 'my suite': a name must be non-empty, without spaces"),
    (lambda: bufgym.suite("mine-v1", {}), "suite mine-v1: needs at least one scenario"),
    (
        lambda: bufgym.suite("mine-v1", {"a": "lte", "b": "topics"}),
        "scenarios of queue and topics: must be of one kind",
    ),
    (lambda: small(seeds=301), "seeds = 301: must be a whole number from 1 to 300"),
    (lambda: small(capacity=[3, 3]), "no two alike"),
    (lambda: small(capacity=0), "capacity = 0: must be a whole number >= 1"),
    (lambda: bufgym.compare("afr", small(), seeds=400), "seeds = 400: must lie between 1 and 300"),
    (
        lambda: suites.named("bufgym:compare"),
        "bufgym:compare: must be a suite, as bufgym.suite.* makes it, not function",
    ),
)
