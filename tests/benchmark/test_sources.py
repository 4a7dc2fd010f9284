"""Policies from files and modules in ``bufgym bench``: by what names, in which processes, and what is refused."""

import json
import re
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from cli_cases import Capsys, Patch, fails, shown
from needs import needs
from refusal_cases import refuse, refused

import bufgym
from bufgym import policies, scenario
from bufgym.benchmark import folder, sources
from bufgym.benchmark.rows import read_rows
from bufgym.benchmark.run import run
from bufgym.policies import REJECT
from bufgym.scenario import FleetScenario

MODULE = """
from bufgym.policies import ACCEPT, REJECT, Policy, register

def newest(buffer, arrival, memory):
    "The newest stay."
    return ACCEPT if len(buffer.slots) < buffer.capacity else 0

def made():
    return Policy("made-here", newest)

def makes_a_function():
    return newest

whole = Policy("whole", newest, compile=True)

@register("every", parameters={"every": 2}, memory={"count": 0})
def every_other(buffer, arrival, memory):
    "Every other one."
    if len(buffer.slots) < buffer.capacity:
        return ACCEPT
    memory[0] += 1
    return REJECT if memory[0] % buffer.parameters[0] else 0

def afr(buffer, arrival, memory):
    return REJECT

def boom(buffer, arrival, memory):
    return 1 // 0

number = 3
"""
LINES = MODULE.split("\n")
SHIPPED = Path(policies.__file__).parents[2] / "agents" / "pretrained" / "learned.safetensors"
ONE = ["--scenario", "interruption:law=fixed,t_max=12", "--capacity", "3", "--seeds", "1"]


@pytest.fixture
def module(tmp_path: Path, monkeypatch: Patch) -> str:
    """A module of policies in the current folder; its name differs from test to test, as Python imports one once."""
    name = "m" + re.sub(r"\W", "_", tmp_path.name)
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    return name


def rows_of(text: str) -> dict[str, str]:
    """The table's lines by policy, without the name; those that a note calls the same have the same line."""
    table = {line.split()[0]: line.split(maxsplit=1)[1] for line in text.split("\n") if len(line.split()) > 5}
    for names, first in re.findall(r"^note: (.*): the same rows here as (.*)$", text, re.MULTILINE):
        table |= dict.fromkeys(names.split(", "), table[first])
    return table


def test_functions_makers_and_policies_of_a_module(module: str, capsys: Capsys) -> None:
    words = [f"{module}:{name}" for name in ("newest", "made", "whole", "every_other")]
    table = rows_of(shown(["bench", *ONE, "--policies", ",".join([*words, "every:every=3", "drop-oldest"])], capsys))
    assert table["newest"] == table["made-here"] == table["whole"] == table["drop-oldest"]
    assert table["every"] != table["every:every=3"]
    assert sources.load(f"{module}:makes_a_function") == "newest"  # as there is already
    shown(["play", "--policies", f"{module}:newest", "--env", "Interruption-v1", "--speed", "1000"], capsys)


def test_a_learned_policys_file_goes_by_its_stem(module: str, capsys: Capsys) -> None:
    shutil.copy(SHIPPED, "own.safetensors")
    table = rows_of(shown(["bench", *ONE, "--policies", "own.safetensors,learned"], capsys))
    assert table["own"] == table["learned"]
    Path("a").mkdir()
    shutil.copy(SHIPPED, "a/own.safetensors")
    message = "own.safetensors: there is a policy named 'own' already"
    fails(["bench", *ONE, "--policies", "own.safetensors,a/own.safetensors"], message, capsys)


@pytest.mark.nightly
def test_workers_load_them_too_and_the_folder_knows_their_version(module: str, capsys: Capsys) -> None:
    pytest.importorskip("joblib", reason=needs("extras", "joblib"))
    shutil.copy(SHIPPED, "own.safetensors")
    suite = "--suite interruption-v1 --capacity 3 --seeds 1 --format csv --jobs 2 --out kept"
    words = ["bench", *suite.split(), "--policies", f"own.safetensors,{module}:newest"]
    shown(words, capsys)
    found = read_rows(Path("kept/rows.csv"))
    by_policy = {name: [row["qoi"] for row in found if row["policy"] == name] for name in ("newest", "drop-oldest")}
    assert by_policy["newest"] == by_policy["drop-oldest"] and len(found) == 12  # 3 scenarios; a sweep runs AFR too
    held = json.loads(Path("kept/manifest.json").read_text())
    assert held["policies"] == ["own", "newest", "drop-oldest", "afr"] and len(held["sources"]) == 2
    assert f"--policies own.safetensors,{module}:newest" in held["command"]
    shown(words, capsys)  # the same again
    with Path(f"{module}.py").open("a") as file:
        file.write("# changed\n")
    fails(words, "sources is", capsys)


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("{}:number", "must be a policy, a function (buffer, arrival, memory), or one without arguments"),
        ("{}:nothing", "has no nothing"),
        ("{}:afr", "there is a policy named 'afr' already"),
        ("{}:boom", f"line {LINES.index('    return 1 // 0') + 1}: ZeroDivisionError"),
        ("nowhere.zip", "nowhere.zip: no such file"),
        ("broken.zip", "broken.zip: no model of stable-baselines3"),
        ("nowhere:policy", "nowhere:policy: neither a policy 'nowhere' nor a module of that name"),
        ("needy:policy", "needy:policy: needy imports a_module_not_there, which is not there"),
        ("afr:policy", "'policy' is not of the form parameter=number"),
    ],
)
def test_what_cannot_be_loaded(module: str, word: str, says: str, capsys: Capsys) -> None:
    if word.endswith(".zip"):
        pytest.importorskip("stable_baselines3", reason=needs("extras", "stable_baselines3"))
    Path("broken.zip").write_text("no zip")
    Path("broken.py").write_text("1 // 0\n")
    Path("needy.py").write_text("import a_module_not_there\n")
    fails(["bench", *ONE, "--policies", word.format(module)], says, capsys)


@pytest.mark.parametrize("word", ["os:system", "mine.zip", "mine.safetensors"])
def test_a_name_from_elsewhere_loads_nothing(word: str) -> None:
    """``policies.get`` also gets names from untrusted leaderboards and results."""
    refuse(r"unknown policy", policies.get, word)


# ``bufgym.compare``: the same rows as the benchmark's, as text, Markdown, a data frame and a picture.


def stubborn(buffer, arrival, memory):
    """Rejects all, room or not."""
    return REJECT


def test_a_scenario_by_name_or_made_and_policies_of_each_kind(tmp_path: Path) -> None:
    done = bufgym.compare(["afr", stubborn], "interruption", capacity=[2, 4], seeds=3, t_max=20, progress=False)
    made = scenario.get("interruption", t_max=20)
    rows = run([policies.get("afr"), policies.get(stubborn)], made, [2, 4], 3, label="interruption")
    unnamed = [{**row, "scenario": ""} for row in rows]
    assert done.rows == rows and bufgym.compare(["afr", stubborn], made, capacity=[2, 4], seeds=3).rows == unnamed
    # The score needs Drop Oldest on the same episodes, though it is no row.
    head, *lines = done.table().splitlines()
    assert head.split()[:5] == ["policy", "L", "score", "QoI", "regret"]
    assert [line.split()[0] for line in lines if line] == ["afr", "stubborn", "afr", "stubborn", "score:", "in"]
    assert done.table("markdown").startswith("| policy | L |") and str(done).startswith("interruption\n\n")
    assert done._repr_html_().count("<tr>") == 5
    assert "<b>afr</b> is first" in done.report(tmp_path / "page.html").read_text()


def test_the_paired_difference_to_a_policy() -> None:
    """It, AFR and Drop Oldest run too; the difference is that of the two shares of AFR's regret."""
    options: dict[str, Any] = {"capacity": [4, 8], "seeds": 20, "progress": False}
    done = bufgym.compare("min-gap", "interruption", against="decimate:every=2", **options)
    assert {row["policy"] for row in done.rows} == {"min-gap", "decimate:every=2", "afr"}
    lines = [line.split() for line in done.table().split("\n\n")[-1].splitlines()]
    shares = {line[0]: line[1:] for line in lines[1:5]}
    assert set(shares) == {"min-gap", "decimate:every=2", "afr", "drop-oldest"} and shares["afr"][0] == "–"
    assert shares["decimate:every=2"][-1] == "–"
    less = float(shares["min-gap"][0]) - float(shares["decimate:every=2"][0])
    assert float(shares["min-gap"][3].replace("−", "-")) == pytest.approx(less, abs=0.0011)
    assert "| min-gap |" in done.table("markdown").split("\n\n")[-2] and done.forms["html"].count("<table>") == 2
    suite = bufgym.compare("afr", "interruption-v1", against="afr", capacity=4, seeds=3, progress=False)
    assert "minus afr's" in suite.table()
    fleet = FleetScenario(robots=2, uplink=scenario.get("lte", duration_s=5.0))
    assert "minus afr's" in bufgym.compare("min-gap", fleet, against="afr", seeds=1).table()


def test_a_comparison_is_kept_in_a_folder_as_the_command_keeps_it(tmp_path: Path) -> None:
    """A scenario's rows and table; a suite's run, which is resumed. Rows of a folder are never written over."""
    options: dict[str, Any] = {"capacity": 2, "seeds": 1, "progress": False, "form": "csv"}
    done = bufgym.compare("afr", "interruption", label="mine", out=tmp_path / "one", t_max=20, **options)
    assert read_rows(tmp_path / "one" / "rows.csv") == done.rows and done.rows[0]["scenario"] == "mine"
    assert (tmp_path / "one" / "table.md").read_text().startswith("mine\n\n| policy |")
    refuse(r"rows\.csv: holds an earlier run's rows", bufgym.compare, "afr", "interruption", out=tmp_path / "one")
    suite = partial(bufgym.compare, "afr", "interruption-v1", out=tmp_path / "two", split="validation", **options)
    assert suite().rows == suite().rows and folder.read(tmp_path / "two").manifest["split"] == "validation"


def test_a_policy_made_here_says_itself_that_it_does_not_compete() -> None:
    endless = policies.Policy("mine", policies.get("drop-oldest").on_arrival, unbounded=True)
    done = bufgym.compare([endless, "drop-oldest"], "interruption", seeds=2, t_max=20)
    assert done.unranked == {"mine": "its queue is unbounded"}
    assert [line.split()[0] for line in done.table().splitlines()[1:3]] == ["drop-oldest", "mine"]


def test_a_suite_takes_files_and_named_policies_and_those_registered_here(tmp_path: Path, monkeypatch: Patch) -> None:
    """A suite's processes load a file themselves; a policy registered in this process runs in this process."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(SHIPPED, "mine.safetensors")
    options: dict[str, Any] = {"capacity": 2, "seeds": 1, "progress": False}
    done = bufgym.compare([Path("mine.safetensors"), "learned"], "interruption-v1", **options)
    assert {row["policy"] for row in done.rows} == {"mine", "learned", "drop-oldest", "afr"}
    policies.register("stubborn")(stubborn)
    done = bufgym.compare(stubborn, "interruption-v1", **options)
    assert {row["policy"] for row in done.rows} == {"stubborn", "drop-oldest", "afr"}


def test_a_picture() -> None:
    pytest.importorskip("matplotlib", reason=needs("extras", "matplotlib"))
    axes = bufgym.compare(["afr", "min-gap"], "interruption", capacity=[2, 4], seeds=2, progress=False).plot()
    assert {label.get_text() for label in axes.get_yticklabels()} == {"min-gap", "afr"}
    assert len(axes.patches) == 4 and axes.get_xlabel().startswith("regret")


def test_a_frame() -> None:
    frame = pytest.importorskip("pandas", reason=needs("extras", "pandas"))
    found = bufgym.compare(["afr"], "interruption", seeds=2, progress=False).to_pandas()
    assert isinstance(found, frame.DataFrame) and found["policy"].tolist() == ["afr", "afr"]
    assert found["scenario"].tolist() == ["interruption", "interruption"]


@pytest.mark.parametrize(
    ("kind", "policy", "baseline", "head"),
    [("topics", "fifo", "robofleet", "QoI"), ("fleet", "min-gap", "afr", "team QoI")],
)
def test_topics_and_fleets_beside_their_baseline(kind: str, policy: str, baseline: str, head: str) -> None:
    made = scenario.get("topics", duration_s=2.0)
    if kind == "fleet":
        made = scenario.FleetScenario.of(2, "lte", duration_s=2.0)
    done = bufgym.compare([policy], made, capacity=4, seeds=1, about="mine")
    assert {row["policy"] for row in done.rows} == {policy, baseline}
    assert done.table().startswith("policy") and head in done.table() and done.to_pandas()["scenario"][0] == "mine"


def test_policies_from_names_functions_and_files(tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text("def every_other(buffer, arrival, memory):\n    return -1 if arrival.seq % 2 else -2\n")
    assert bufgym.make_policy("decimate:every=3").parameters["every"] == 3
    assert bufgym.make_policy(stubborn).name == "stubborn"
    assert bufgym.make_policy("mine:every_other").name == "every_other"
    assert bufgym.make_policy(policies.get("afr")).name == "afr"


test_what_is_wrong_is_named = refused(
    (lambda: bufgym.compare([stubborn], "outage-v1", jobs=2), "policy stubborn: known to this process alone: jobs = 1"),
    (lambda: bufgym.compare([]), "policies = .*: need at least one"),
    (lambda: bufgym.compare(["afr"], "outage-v1", duration_s=3.0), "duration_s: a suite's episodes are frozen"),
    (
        lambda: bufgym.compare(["afr"], "interruption", seeds=1).table("html"),
        "form = 'html': must be one of 'plain', 'markdown', 'latex'",
    ),
)
