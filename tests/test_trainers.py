"""Each program of examples/trainers runs, where its library is installed.

A library that pins other versions than bufgym's tests use has an environment of its own: ``BUFGYM_TRAINERS`` names a
folder of them, ``venv-skrl`` for ``skrl``. The interpreter that runs the tests serves the others.
"""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from needs import needs

REPO = Path(__file__).resolve().parent.parent
PAGE = (REPO / "docs" / "guide" / "trainers.md").read_text(encoding="utf-8")
PROGRAMS = {
    path.stem.removeprefix("with_"): path for path in sorted((REPO / "examples" / "trainers").glob("with_*.py"))
}
"""Package -> the program that trains with it."""
QUICK = ("tianshou", "torch", "torchrl")
"""Those that run with every test, if they are installed."""
FOLDER = "BUFGYM_TRAINERS"


def interpreter(package: str) -> str | None:
    """Python of the package's own environment, or of this one; None where the package is missing."""
    own = Path(os.environ[FOLDER], f"venv-{package}", "bin", "python") if FOLDER in os.environ else None
    if own and own.exists():
        return str(own)
    return sys.executable if importlib.util.find_spec(package) else None


def test_every_library_of_the_table_has_a_program() -> None:
    rows = re.findall(r"^\| \[[^|]+\]\(([^|]+)\) \| `(\w+)` \|", PAGE, re.MULTILINE)
    assert len(rows) > 2 and sorted(package for _, package in rows) == sorted(PROGRAMS)
    assert not [link for link, package in rows if Path(link).name != PROGRAMS[package].name]
    [nightly] = re.findall(r"^ +library: \[(.*)\]$", (REPO / ".github/workflows/nightly.yml").read_text(), re.MULTILINE)
    assert sorted(nightly.split(", ")) == sorted(PROGRAMS)


@pytest.mark.parametrize(
    "package", [pytest.param(name, marks=[] if name in QUICK else pytest.mark.nightly) for name in PROGRAMS]
)
def test_the_program_runs(package: str, tmp_path: Path) -> None:
    python = interpreter(package)
    if python is None:
        pytest.skip(needs("torchrl" if package == "torchrl" else "trainers", package))
    path = os.pathsep.join(str(REPO / part) for part in ("", "packages/robot", "packages/papers"))
    where = os.environ | {"PYTHONPATH": path, "MINARI_DATASETS_PATH": str(tmp_path / "data"), "OMP_NUM_THREADS": "1"}
    command = [python, str(PROGRAMS[package])]
    done = subprocess.run(command, cwd=tmp_path, env=where, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
