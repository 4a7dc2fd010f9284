"""Tuning on validation episodes: the best setting of a suite that is worked out by hand, chance, ties, bad input."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from cli_cases import Capsys, Patch
from cyclopts import App
from refusal_cases import refuse

from bufgym import policies
from bufgym.benchmark import tuned
from bufgym.benchmark.tasks import TASKS
from bufgym.cli.options import OPTIONS
from bufgym.model import qoi
from bufgym.scenario import Interruption, suites
from bufgym.utils.strict_json import read_object
from studies import tune
from studies.tune import Choice

LENGTHS = {"tiny-twelve": 12, "tiny-nine": 9}
"""T of each suite, L = 2. Of messages 1..T, `decimate:every=k` accepts 1, 1 + k, 1 + 2k, ... and keeps the last two.

T = 12: every=4 keeps 5 and 9, and with 0 and 13 at the ends no gaps are more even than 5, 4, 4.
T = 9: every=3, the default, keeps 4 and 7, with gaps of 4, 3, 3."""


@pytest.fixture(autouse=True)
def splits(tmp_path: Path, monkeypatch: Patch) -> Iterator[list[str]]:
    """The splits asked for, of two tiny suites; results go to a file of the test's own."""
    asked: list[str] = []

    def suite(name: str, T: int) -> suites.Suite:
        def build(split: str, data: Path | None) -> dict[str, suites.Setting]:
            asked.append(split)
            return {"one": suites.Setting(Interruption(law="fixed", t_max=T, value=qoi.exponential(0.9)), f"T = {T}")}

        return suites.Suite(name, "two episodes", build, capacities=(2,), seeds=2)

    for name, T in LENGTHS.items():
        monkeypatch.setitem(suites.SUITES, name, suite(name, T))
    monkeypatch.setattr(tuned, "FILE", tmp_path / "tuned.json")
    yield asked


default_policies = TASKS["queue"].default_policies


def cli(words: str, capsys: Capsys) -> str:
    app = App(default_command=tune.main, default_parameter=OPTIONS, result_action="return_value")
    app([*words.split(), "--jobs", "1"])
    return capsys.readouterr().out


def test_the_best_setting_of_a_suite_worked_out_by_hand(splits: list[str]) -> None:
    (choice,) = tune.tune("tiny-twelve", ["decimate"], jobs=1)
    assert choice.default.spec == "decimate"
    assert choice.best.spec == choice.chosen.spec == "decimate:every=4"
    assert choice.best.score.value == pytest.approx(1)
    assert choice.best.regret.value == pytest.approx(0, abs=1e-12)
    # The default keeps 7 and 10, Drop Oldest 11 and 12, the clairvoyant 5 and 9; V(d) = 1 - 0.9^d.
    default, oldest, most = (sum(1 - 0.9**d for d in gaps) for gaps in ((7, 3, 3), (11, 1, 1), (5, 4, 4)))
    assert choice.default.score.value == pytest.approx((default - oldest) / (most - oldest))
    assert choice.best.gain.value == pytest.approx(1 - choice.default.score.value)
    assert set(splits) == {"validation"}


def test_the_default_is_kept_where_it_is_best_and_on_ties() -> None:
    """T = 12 at 30 Hz is over after 0.4 s: lifespans of 0.5 s (the default) and more are one and the same."""
    (choice,) = tune.tune("tiny-nine", ["decimate"], jobs=1)
    assert choice.default.score.value == pytest.approx(1)
    assert choice.chosen is choice.best is choice.default
    (choice,) = tune.tune("tiny-twelve", ["lifespan"], jobs=1)
    same = [tried for tried in choice.tried if tried.score.value == pytest.approx(choice.default.score.value)]
    assert {tried.spec for tried in same} >= {"lifespan", "lifespan:lifespan_s=1", "lifespan:lifespan_s=20"}
    assert choice.chosen is choice.default


def test_every_built_in_policy_with_parameters_is_tuned_or_says_why_not() -> None:
    """Settings begin with the default and repeat nothing."""
    built_in = [policies.get(name) for name in policies.names()]
    with_parameters = {p.name for p in built_in if p.parameters and p.built_in}
    kinds = (tune.GRIDS, tune.AROUND, tune.FIXED)
    assert with_parameters == set().union(*kinds) and len(with_parameters) == sum(map(len, kinds))
    for name in (*tune.GRIDS, *tune.AROUND):
        specs = tune.settings(name)
        parameters = {tuple(policies.get(spec).parameters.items()) for spec in specs}
        assert specs[0] == name and len(parameters) == len(specs) > 1


def compared(base: Sequence[float], default: Sequence[float], other: Sequence[float], best: float) -> Choice:
    rows = [
        {"scenario": "s", "capacity": 2, "trace": "t", "seed": i, "policy": name, "qoi": float(h), "clairvoyant": best}
        for name, values in (("drop-oldest", base), ("p", default), ("p:a=1", other))
        for i, h in enumerate(values)
    ]
    return tune.compare("p", rows, ["p", "p:a=1"])


def test_a_gain_that_may_be_chance_is_none() -> None:
    choice = compared([10] * 4, [15] * 4, [18, 13, 18, 13], 20)  # +3, -2, +3, -2
    assert choice.best.spec == "p:a=1"
    assert choice.best.gain.value == pytest.approx(0.05)
    assert choice.best.gain.low < 0 < choice.best.gain.high
    assert choice.chosen is choice.default


def test_the_command_writes_what_bench_then_reads(capsys: Capsys) -> None:
    text = cli("tiny-twelve --policies decimate,lifespan --seeds 3", capsys)
    assert "best, chosen" in text and "default, best, chosen" in text and not tuned.FILE.exists()
    refuse("never chosen on test episodes", cli, "tiny-twelve --split test --write", capsys)
    assert not tuned.FILE.exists()
    cli("tiny-twelve --policies decimate,lifespan --seeds 3 --write", capsys)
    entry = read_object(tuned.FILE)["tiny-twelve"]["decimate"]
    assert entry["setting"] == "decimate:every=4" and entry["split"] == "validation"
    assert entry["score"] == pytest.approx(1) and entry["score"] > entry["default_score"]
    assert entry["command"] == "python -m studies.tune tiny-twelve --policies decimate,lifespan --seeds 3 --write"
    # A second suite leaves the first alone; lifespan stays at its default.
    cli("tiny-nine --policies decimate --write", capsys)
    assert [tuned.tuned(name) for name in (*LENGTHS, "lte-v1")] == [["decimate:every=4"], [], []]
    assert default_policies("tiny-twelve") == [*policies.names(for_topics=False), "decimate:every=4"]


def test_what_is_shipped(monkeypatch: Patch) -> None:
    monkeypatch.setattr(tuned, "FILE", Path(tuned.__file__).with_name("tuned.json"))
    shipped = read_object(tuned.FILE)
    assert shipped and set(shipped) <= set(suites.SUITES)
    for suite, entries in shipped.items():
        specs = default_policies(suite)
        assert len(set(specs)) == len(specs)
        for policy, entry in entries.items():
            assert entry["setting"] in tune.settings(policy) and entry["split"] == "validation"
            command = entry["command"]
            assert command.startswith(f"python -m studies.tune {suite}") and command.endswith("--write")
            assert (entry["setting"] == policy) == (entry["setting"] not in tuned.tuned(suite))
    assert json.dumps(shipped, indent=1, sort_keys=True) + "\n" == tuned.FILE.read_text(encoding="utf-8")


def test_settings_are_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tuned, "FILE", tmp_path / "tuned.json")
    tune.keep("lte-v1", [], split="validation", again="")
    before = tuned.FILE.read_bytes()

    def half(path: Path, text: str, **_: object) -> None:
        path.write_bytes(text.encode()[:20])
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_text", half)
    refuse("No space", tune.keep, "lte-v1", [], split="validation", again="", kind=OSError)
    assert tuned.FILE.read_bytes() == before and list(tmp_path.iterdir()) == [tuned.FILE]
