"""Tuning on validation episodes: the best setting of a suite that is worked out by hand, chance, ties, bad input."""

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from cli_cases import Capsys, Patch
from cyclopts import App
from refusal_cases import refuse

from agents import tune
from agents.tune import Choice
from bufgym import policies
from bufgym.benchmark import tuned
from bufgym.benchmark.tasks import TASKS
from bufgym.cli.options import OPTIONS
from bufgym.ground.errors import BufgymError
from bufgym.model import qoi
from bufgym.scenario import Interruption, Uplink, suites
from bufgym.traces import Trace

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


def test_test_episodes_are_refused_before_any_is_drawn(splits: list[str]) -> None:
    with pytest.raises(BufgymError, match=r"split = 'test': .* never chosen on test episodes"):
        tune.tune("tiny-twelve", ["decimate"], split="test", jobs=1)
    assert splits == []


@pytest.mark.parametrize(
    ("suite", "names", "more", "message"),
    [
        ("tiny-twelve", ["decimate:every=2"], {}, "policy 'decimate:every=2': no grid"),
        ("tiny-twelve", ["ros-keep-last"], {}, "ros-keep-last: is not tuned: it stands for ROS 2"),
        ("topics-v1", ["decimate"], {}, "suite topics-v1: only policies of one queue are tuned"),
    ],
)
def test_what_cannot_be_tuned(suite: str, names: list[str], more: dict[str, Any], message: str) -> None:
    refuse(message, tune.tune, suite, names, jobs=1, **more)


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


def test_one_parameter_at_a_time_around_the_default() -> None:
    default = policies.get("gap-price").parameters
    specs = tune.settings("gap-price")
    assert len(specs) == 1 + len(tune.FACTORS) * sum(number > 0 for number in default.values())
    assert "gap-price:near=3" in specs and "gap-price:kappa=0.96" in specs  # twice 1.5 and 0.48
    for spec in specs[1:]:
        assert len(dict(policies.get(spec).parameters).items() - default.items()) == 1
    assert not any("discount" in spec for spec in tune.settings("price-dp"))


@pytest.mark.parametrize("sizes", ["equal", "jpeg"])
def test_our_own_rules_are_tuned_for_equal_and_unequal_sizes(sizes: str, monkeypatch: Patch, splits: list[str]) -> None:
    """The price of bytes changes what gap-price does only where sizes differ; price-dp reads each of its numbers."""
    link = Trace.steps([(2, 2e6), (1, 0), (3, 1e6), (2, 4e6)], name="fading")
    scenario = Uplink((link,), sizes=sizes, duration_s=20.0, value=qoi.exponential(0.5))
    settings = {"one": suites.Setting(scenario, "a camera")}
    tiny = suites.Suite("tiny-camera", "", lambda split, data: settings, capacities=(4,), seeds=3)
    monkeypatch.setitem(suites.SUITES, "tiny-camera", tiny)
    moved: dict[str, set[str]] = {}
    for choice in tune.tune("tiny-camera", list(tune.AROUND), split="train", jobs=1):
        gained = [tried.spec.partition(":")[2] for tried in choice.tried if abs(tried.gain.value) > 1e-12]
        moved[choice.policy] = {spec.partition("=")[0] for spec in gained}
        assert choice.chosen.gain.value >= 0 and 0 < choice.default.score.value < 1
    assert "horizon_s" in moved["target-gap"]
    assert moved["price-dp"] <= set(tune.AROUND["price-dp"]) and "kappa" in moved["price-dp"]
    assert ("kappa" in moved["gap-price"]) == (sizes == "jpeg")
    if sizes == "equal":
        assert moved["gap-price"] - moved["target-gap"] <= {"share_low"}  # half of it is a share of .18 for equal sizes


def compared(base: Sequence[float], default: Sequence[float], other: Sequence[float], best: float) -> Choice:
    rows = [
        {"scenario": "s", "capacity": 2, "trace": "t", "seed": i, "policy": name, "qoi": float(h), "clairvoyant": best}
        for name, values in (("drop-oldest", base), ("p", default), ("p:a=1", other))
        for i, h in enumerate(values)
    ]
    return tune.compare("p", rows, ["p", "p:a=1"])


def test_the_gain_is_the_paired_difference_of_the_scores() -> None:
    """Every episode gains 1 of the 10 that can be gained: whatever is drawn, 0.1, though the scores themselves vary."""
    choice = compared([10, 10, 10, 10], [11, 15, 12, 18], [12, 16, 13, 19], 20)
    assert choice.default.score.value == pytest.approx((1 + 5 + 2 + 8) / 40)
    assert choice.tried[1].score.value == pytest.approx(choice.default.score.value + 0.1)
    assert choice.tried[1].gain == pytest.approx((0.1, 0.1, 0.1))
    assert choice.default.gain == pytest.approx((0, 0, 0), abs=1e-12)
    assert choice.chosen.spec == "p:a=1"


def test_a_gain_that_may_be_chance_is_none() -> None:
    choice = compared([10] * 4, [15] * 4, [18, 13, 18, 13], 20)  # +3, -2, +3, -2
    assert choice.best.spec == "p:a=1"
    assert choice.best.gain.value == pytest.approx(0.05)
    assert choice.best.gain.low < 0 < choice.best.gain.high
    assert choice.chosen is choice.default


def test_where_no_cell_is_discriminative_regrets_are_compared() -> None:
    """Drop Oldest loses 0.5 %: no scores. Of 200, the default gets 180 and the other setting 190."""
    choice = compared([199, 199], [180, 180], [190, 190], 200)
    assert math.isnan(choice.best.score.value) and choice.chosen.spec == "p:a=1"
    assert [tried.regret.value for tried in choice.tried] == pytest.approx([0.1, 0.05])
    assert choice.chosen.gain == pytest.approx((0.05, 0.05, 0.05))
    assert compared([199, 199], [190, 190], [180, 180], 200).chosen.spec == "p"


def test_the_command_writes_what_bench_then_reads(capsys: Capsys) -> None:
    text = cli("tiny-twelve --policies decimate,lifespan --seeds 3", capsys)
    assert "best, chosen" in text and "default, best, chosen" in text and not tuned.FILE.exists()
    refuse("never chosen on test episodes", cli, "tiny-twelve --split test --write", capsys)
    assert not tuned.FILE.exists()
    cli("tiny-twelve --policies decimate,lifespan --seeds 3 --write", capsys)
    entry = tuned.read()["tiny-twelve"]["decimate"]
    assert entry["setting"] == "decimate:every=4" and entry["split"] == "validation"
    assert entry["score"] == pytest.approx(1) and entry["score"] > entry["default_score"]
    assert entry["command"] == "python -m agents.tune tiny-twelve --policies decimate,lifespan --seeds 3 --write"
    # A second suite leaves the first alone; lifespan stays at its default.
    cli("tiny-nine --policies decimate --write", capsys)
    assert [tuned.tuned(name) for name in (*LENGTHS, "lte-v1")] == [["decimate:every=4"], [], []]
    assert default_policies("tiny-twelve") == [*policies.names(for_topics=False), "decimate:every=4"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"{", "line 1: must be JSON"),
        (b'{"lte-v1": {"decimate": 3}}', r"lte-v1.decimate.setting = '': must be a setting of that policy"),
        (b'{"lte-v1": {"decimate": {"setting": "afr"}}}', r"lte-v1.decimate.setting = afr: must be a setting of that"),
        (b'{"lte-v1": {"nobody": {"setting": "nobody:a=2"}}}', "lte-v1.nobody: unknown policy 'nobody'"),
    ],
)
def test_a_broken_file_is_named(text: bytes, message: str) -> None:
    tuned.FILE.write_bytes(text)
    refuse(f"{tuned.FILE.name}.*{message}", default_policies, "lte-v1")


def test_what_is_shipped(monkeypatch: Patch) -> None:
    monkeypatch.setattr(tuned, "FILE", Path(tuned.__file__).with_name("tuned.json"))
    shipped = tuned.read()
    assert shipped and set(shipped) <= set(suites.SUITES)
    for suite, entries in shipped.items():
        specs = default_policies(suite)
        assert len(set(specs)) == len(specs)
        for policy, entry in entries.items():
            assert entry["setting"] in tune.settings(policy) and entry["split"] == "validation"
            command = entry["command"]
            assert command.startswith(f"python -m agents.tune {suite}") and command.endswith("--write")
            assert (entry["setting"] == policy) == (entry["setting"] not in tuned.tuned(suite))
    assert json.dumps(shipped, indent=1, sort_keys=True) + "\n" == tuned.FILE.read_text(encoding="utf-8")
