"""Container, hooks and workflow name what is there: rules of the Makefile, Pythons that are supported, programs."""

from __future__ import annotations

import os
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest

from bufgym import cli

REPO = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((REPO / "pyproject.toml").read_text(encoding="utf-8"))["project"]
RULES = re.findall(r"^([\w-]+):", (REPO / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
PYTHONS = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))


def read_yaml(name: str) -> Any:
    yaml = pytest.importorskip("yaml", reason="the extra docs is not installed")
    return yaml.safe_load((REPO / name).read_text(encoding="utf-8"))


def test_the_container_runs_rules_and_commands_that_there_are() -> None:
    text = (REPO / "Dockerfile").read_text(encoding="utf-8")
    lines = re.sub(r"\\\n\s*", " ", re.sub(r"^#.*\n", "", text, flags=re.MULTILINE)).splitlines()
    said = {
        word: [line.partition(" ")[2] for line in lines if line.startswith(word)] for word in ("FROM", "RUN", "CMD")
    }
    assert sum(map(len, said.values())) + len(["WORKDIR", "COPY"]) == len(lines)
    assert re.fullmatch(r"python:(3\.\d+)-slim", said["FROM"][0])[1] in PYTHONS  # type: ignore[index]
    setup, warmup = (shlex.split(part) for part in said["RUN"][-1].split("&&"))
    # The first is the rule that all others need.
    assert setup == ["make", ".venv/.ready"] and "READY := $(VENV)/.ready" in (REPO / "Makefile").read_text()
    assert warmup[0] == ".venv/bin/bufgym" and cli._parser().parse_args(warmup[1:]).command
    told = re.findall(r"\bmake (\w+)", text) + re.findall(r'"make", "(\w+)"', said["CMD"][0])
    assert {"train", "test"} <= set(told) <= set(RULES)
    left_out = (REPO / ".dockerignore").read_text(encoding="utf-8").split()
    assert not {"bufgym", "agents", "traces", "tests", "docs", "Makefile", "pyproject.toml"} & set(left_out)


def test_the_workflow_tries_every_python_that_is_supported() -> None:
    workflow = read_yaml(".github/workflows/test.yml")
    (job,) = workflow["jobs"].values()
    assert job["strategy"]["matrix"]["python"] == PYTHONS
    (script,) = [step["run"] for step in job["steps"] if "run" in step]
    assert os.access(REPO / script, os.X_OK)
    assert f"${{PYTHONS:-{' '.join(PYTHONS)}}}" in (REPO / ".ci" / "install-matrix").read_text(encoding="utf-8")
    assert (
        f"Python >= {PYTHONS[0]}" in (REPO / "Makefile").read_text() and PROJECT["requires-python"] == f">={PYTHONS[0]}"
    )


def test_the_hooks_run_what_make_test_runs() -> None:
    (local,) = read_yaml(".pre-commit-config.yaml")["repos"]
    assert local["repo"] == "local"  # nothing is fetched from elsewhere
    tested = (REPO / "Makefile").read_text(encoding="utf-8")
    for hook in local["hooks"]:
        program, *words = hook["entry"].split()
        assert hook["language"] == "system" and program.startswith(".venv/bin/")
        assert " ".join([program.replace(".venv/bin", "$(BIN)"), *words[:1]]) in tested
