"""The table of docs/where-to-add.md, tried: in a copy, each row's thing is added where the row says, and used.

One process of plain Python uses them all. What is tried is where lines go, and how few they are.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from addition_cases import REPO, ROWS, copied, surroundings

USES = """
import asyncio, json, sys, traceback
import gymnasium as gym, numpy as np
import bufgym, bufgym.policies, bufgym.scenario, bufgym.traces
from bufgym.cli import main
faults = {}
for row, use in json.loads(sys.argv[1]).items():
    try:
        exec(use)
    except BaseException:
        faults[row] = traceback.format_exc()
print()
print(json.dumps(faults))
"""


ELSEWHERE = {"a learner": "test_a_new_learner_is_a_class_and_its_settings"}
"""Row -> the test that tries it."""


def test_each_row_of_the_table_is_tried() -> None:
    text = (REPO / "docs" / "where-to-add.md").read_text(encoding="utf-8")
    table = text.partition("| new | goes to |\n|---|---|\n")[2].partition("\n\n")[0]
    assert set(re.findall(r"^\| ([^|]+) \|", table, re.MULTILINE)) == {*ROWS, *ELSEWHERE}


@pytest.fixture(scope="module")
def faults(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What went wrong with a row's thing, in a process that uses all of them."""
    done = subprocess.run(
        [sys.executable, "-c", USES, json.dumps({row: addition.use for row, addition in ROWS.items()})],
        cwd=tmp_path_factory.mktemp("used"),
        env=surroundings(copied(tmp_path_factory.mktemp("copy"), ROWS)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    answers: dict[str, str] = json.loads(done.stdout.splitlines()[-1])
    return answers


@pytest.mark.parametrize("row", ROWS)
def test_what_a_row_adds_is_there(row: str, faults: dict[str, str]) -> None:
    assert row not in faults, faults[row]


CONTRIBUTIONS = ("a policy", "an observation field", "a trace format")
CHECKS = {
    "tests/core/naive_policies.py": "core/test_policy_registry.py::test_each_built_in_policy_has_a_reference_model",
    "docs/guide/yours-to-change.md": "core/test_observe.py::test_each_field_on_board_is_on_its_page",
    "tests/traces/link_files.py": "traces/test_readers.py::test_each_format_has_a_sample",
    "docs/guide/recordings.md": "traces/test_readers.py::test_each_format_has_a_row",
}
"""File of a step that is easily forgotten -> the test that names it."""


def run(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a module in the copy."""
    command = [sys.executable, "-m", *words]
    return subprocess.run(command, cwd=folder, env=surroundings(folder), capture_output=True, text=True, check=False)


def checked(folder: Path, *tests: str) -> subprocess.CompletedProcess[str]:
    return run(
        folder, "pytest", "-q", "-p", "no:cacheprovider", "-m", "not nightly", *(f"tests/{name}" for name in tests)
    )


def test_a_forgotten_step_is_named_by_its_file(tmp_path: Path) -> None:
    done = checked(copied(tmp_path, CONTRIBUTIONS, forgotten=CHECKS), *CHECKS.values())
    assert f"{len(CHECKS)} failed" in done.stdout, done.stdout + done.stderr
    for file, name in zip(CHECKS, ("newest-two", "half_full", "kilobytes", "kilobytes"), strict=True):
        assert re.search(rf"^E +AssertionError: .*({name}.*{file}|{file}.*{name})", done.stdout, re.MULTILINE), file


@pytest.mark.nightly
@pytest.mark.timeout(900)  # mypy has nothing cached
def test_contributions_pass_the_checks(tmp_path: Path) -> None:
    folder = copied(tmp_path, CONTRIBUTIONS)
    changed = [
        name for row in CONTRIBUTIONS for name in ROWS[row].lines if name.startswith("bufgym/") and name.endswith(".py")
    ]
    for words in (("ruff", "format", "--check", "."), ("ruff", "check", "."), ("mypy", *changed)):
        done = run(folder, *words)
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.nightly
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "file", sorted({name.partition("::")[0] for name in CHECKS.values()} | {"core/test_on_board.py"})
)
def test_contributions_pass_the_tests_of_their_registries(file: str, tmp_path: Path) -> None:
    done = checked(copied(tmp_path, CONTRIBUTIONS), file)
    assert done.returncode == 0, done.stdout + done.stderr
