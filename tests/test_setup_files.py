"""Workflows name what is there: rules of the Makefile, supported Pythons, programs."""

import os
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest

REPO = Path(__file__).resolve().parent.parent
if not (REPO / ".github").is_dir():
    pytest.skip("an sdist has no workflows", allow_module_level=True)
PROJECT = tomllib.loads((REPO / "pyproject.toml").read_text(encoding="utf-8"))["project"]
MAKEFILE = (REPO / "Makefile").read_text(encoding="utf-8")
RULES = set(re.findall(r"^([\w.$()/-]+):", MAKEFILE.replace("$(READY)", ".venv/.ready"), re.MULTILINE))
PYTHONS = re.findall(r"Python :: (3\.\d+)", "\n".join(PROJECT["classifiers"]))
WORKFLOWS = sorted(path.name for path in (REPO / ".github" / "workflows").iterdir())


def read_yaml(name: str) -> Any:
    yaml = pytest.importorskip("yaml", reason="the extra docs is not installed")
    return yaml.safe_load((REPO / name).read_text(encoding="utf-8"))


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
    assert PROJECT["requires-python"] == f">={PYTHONS[0]}"
