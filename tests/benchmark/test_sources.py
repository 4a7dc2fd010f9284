"""Policies from files and modules in ``bufgym bench``: by what names, in which processes, and what is refused."""

import json
import re
import shutil
from pathlib import Path

import pytest
from cli_cases import Capsys, Patch, fails, shown
from refusal_cases import refuse

from bufgym import policies
from bufgym.benchmark import sources
from bufgym.benchmark.rows import read_rows
from bufgym.policies import registry

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
ONE = ["--interruption", "--law", "fixed", "--t-max", "12", "--capacity", "3", "--seeds", "1"]


@pytest.fixture
def module(tmp_path: Path, monkeypatch: Patch) -> str:
    """A module of policies in the current folder; its name differs from test to test, as Python imports one once."""
    name = "m" + re.sub(r"\W", "_", tmp_path.name)
    (tmp_path / f"{name}.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))
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
    shown(["play", "--policies", f"{module}:newest", "--env", "Interruption-v0", "--speed", "0"], capsys)


def test_a_learned_policys_file_goes_by_its_stem(module: str, capsys: Capsys) -> None:
    shutil.copy(SHIPPED, "own.safetensors")
    table = rows_of(shown(["bench", *ONE, "--policies", "own.safetensors,learned"], capsys))
    assert table["own"] == table["learned"]
    Path("a").mkdir()
    shutil.copy(SHIPPED, "a/own.safetensors")
    told = "own.safetensors: there is a policy named 'own' already"
    fails(["bench", *ONE, "--policies", "own.safetensors,a/own.safetensors"], told, capsys)


@pytest.mark.nightly
def test_workers_load_them_too_and_the_folder_knows_their_version(module: str, capsys: Capsys) -> None:
    pytest.importorskip("joblib")
    shutil.copy(SHIPPED, "own.safetensors")
    suite = "--suite interruption-v1 --capacity 3 --seeds 1 --format csv --jobs 2 --out kept"
    words = ["bench", *suite.split(), "--policies", f"own.safetensors,{module}:newest"]
    shown(words, capsys)
    found = read_rows(Path("kept/rows.csv"))
    by_policy = {name: [row["qoi"] for row in found if row["policy"] == name] for name in ("newest", "drop-oldest")}
    assert by_policy["newest"] == by_policy["drop-oldest"] and len(found) == 9
    held = json.loads(Path("kept/manifest.json").read_text())
    assert held["policies"] == ["own", "newest", "drop-oldest"] and len(held["sources"]) == 2
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
        pytest.importorskip("stable_baselines3")
    Path("broken.zip").write_text("no zip")
    Path("broken.py").write_text("1 // 0\n")
    Path("needy.py").write_text("import a_module_not_there\n")
    fails(["bench", *ONE, "--policies", word.format(module)], says, capsys)


@pytest.mark.parametrize("word", ["os:system", "mine.zip", "mine.safetensors"])
def test_a_name_from_elsewhere_loads_nothing(word: str) -> None:
    """``policies.get`` also gets names from leaderboards and results of strangers."""
    refuse(r"unknown policy", policies.get, word)
