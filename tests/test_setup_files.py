"""Container, hooks, workflows and stages name what is there: rules of the Makefile, supported Pythons, programs."""

import importlib.util
import os
import re
import shlex
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
from cli_cases import Patch

from bufgym import cli

REPO = Path(__file__).resolve().parent.parent
if not (REPO / ".github").is_dir():
    pytest.skip("an sdist has no workflows", allow_module_level=True)
PROJECT = tomllib.loads((REPO / "pyproject.toml").read_text(encoding="utf-8"))["project"]
MAKEFILE = (REPO / "Makefile").read_text(encoding="utf-8")
RULES = set(re.findall(r"^([\w.$()/-]+):", MAKEFILE.replace("$(READY)", ".venv/.ready"), re.MULTILINE))
PYTHONS = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
WORKFLOWS = sorted(path.name for path in (REPO / ".github" / "workflows").iterdir())


def script(name: str) -> Any:
    """A program of `.ci`, as a module."""
    spec = importlib.util.spec_from_file_location(name, REPO / ".ci" / f"{name}.py")
    assert spec and spec.loader
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


stages = script("stages")


def read_yaml(name: str) -> Any:
    yaml = pytest.importorskip("yaml", reason="the extra docs is not installed")
    return yaml.safe_load((REPO / name).read_text(encoding="utf-8"))


def test_the_container_runs_rules_and_commands_that_there_are() -> None:
    text = (REPO / "Dockerfile").read_text(encoding="utf-8")
    lines = re.sub(r"\\\n\s*", " ", re.sub(r"^#.*\n", "", text, flags=re.MULTILINE)).splitlines()
    setup, warmup = (shlex.split(part) for part in lines[-2].removeprefix("RUN ").split("&&"))
    assert setup == ["make", ".venv/.ready"]
    assert warmup[0] == ".venv/bin/bufgym" and cli.app().parse_args(warmup[1:])
    told = re.findall(r"\bmake (\w+)", text) + re.findall(r'"make", "(\w+)"', lines[-1])
    assert {"train", "test"} <= set(told) <= RULES
    assert re.fullmatch(r"FROM python:(3\.\d+)-slim", lines[0])[1] in PYTHONS  # type: ignore[index]
    left_out = (REPO / ".dockerignore").read_text(encoding="utf-8").split()
    assert not {"bufgym", "agents", "traces", "tests", "docs", ".ci", "Makefile", "pyproject.toml"} & set(left_out)


@pytest.mark.parametrize("name", WORKFLOWS)
def test_workflows_run_rules_and_scripts_that_there_are(name: str) -> None:
    for job in read_yaml(f".github/workflows/{name}")["jobs"].values():
        for step in job.get("steps", []):
            program, *words = shlex.split(step.get("run", "").splitlines()[0]) if "run" in step else ("",)
            if program == "make":
                assert words[0] in RULES
            elif program.startswith(".ci/"):
                assert os.access(REPO / program, os.X_OK) and {*words} <= RULES
            elif program == ".venv/bin/python":
                assert all((REPO / word).exists() for word in words if word.startswith("tests/"))


def test_every_supported_python_is_tried() -> None:
    assert read_yaml(".github/workflows/test.yml")["jobs"]["test"]["strategy"]["matrix"]["python"] == PYTHONS
    for name in ("nightly.yml", "release.yml"):
        assert set(PYTHONS) <= set(re.findall(r"^ +(3\.\d+)$", (REPO / ".github/workflows" / name).read_text(), re.M))
    assert set(PYTHONS) <= set(stages.PYTHONS)
    assert PROJECT["requires-python"] == f">={PYTHONS[0]}"


@pytest.mark.parametrize("tier", ["check", "test", "nightly"])
def test_stages_name_programs_and_rules_that_there_are(tier: str) -> None:
    made = stages.check() if tier == "check" else getattr(stages, tier)([])
    assert len({stage.name for stage in made}) == len(made)
    for stage in made:
        if stage.command[0] == "make":
            assert stage.command[2] in RULES
        elif not stage.unless:
            assert os.access(REPO / stage.command[0], os.X_OK)


def run(stage: Any, log: Path | None = None) -> tuple[str, str]:
    result = stages.carry_out(stage, log)
    return result.outcome, result.remark


def program(text: str, **others: Any) -> Any:
    return stages.Stage("tale", [sys.executable, "-c", text], **others)


@pytest.mark.parametrize(
    "text, came_of_it",
    [
        ("print('all well')", ("passed", "all well")),
        ("print('it broke\\n'); exit(3)", ("FAILED", "it broke")),
        ("print('no Python 2'); exit(77)", ("skipped", "no Python 2")),
        ("import os; os.abort()", ("FAILED", "exit code -6")),
    ],
)
def test_a_stage_says_what_came_of_it(tmp_path: Path, text: str, came_of_it: tuple[str, str]) -> None:
    assert run(program(text), tmp_path / "log") == came_of_it


@pytest.mark.parametrize("tier, ran", [("test", ["one"]), ("nightly", ["one", "two"])])
def test_a_failure_ends_a_commit_but_no_night(tmp_path: Path, monkeypatch: Patch, tier: str, ran: list[str]) -> None:
    monkeypatch.setattr(stages, "REPO", tmp_path)
    two = [stages.Stage(name, [sys.executable, "-c", f"exit({code})"]) for name, code in (("one", 1), ("two", 0))]
    monkeypatch.setattr(stages, tier, lambda arguments: two)
    assert stages.main(tier, []) == 1
    summary = (tmp_path / "build" / tier / "summary.txt").read_text().splitlines()[1:-1]
    assert [line.split()[0] for line in summary] == ran


def test_the_sdist_runs_tests_that_there_are() -> None:
    assert all((REPO / name).exists() for name in script("sdist").TESTS)
