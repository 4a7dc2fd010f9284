"""What comes with bufgym: made by the calls that are stated, and enough to run every command without a network."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bufgym.traces import drive_motion, load, load_motion, shipped, synthetic_lte
from bufgym.traces.generators import shipped_calls

ROOT = Path(__file__).resolve().parents[2]

OFFLINE = """
import socket
import sys

def unplugged(*arguments, **options):
    raise AssertionError("the network was asked")

socket.socket.connect = socket.getaddrinfo = unplugged
import bufgym
from bufgym.cli import main

assert bufgym.__file__.startswith(sys.argv[1]), bufgym.__file__
for line in sys.stdin:
    words = line.split()
    print(">", *words, flush=True)
    assert main(words) == 0, words
"""

COMMANDS = """
list
trace info lte-synthetic-0
trace fetch --list
bench --seconds 1 --fps 10 --seeds 1 --capacity 2 --policies afr,drop-oldest --format csv --out bench
"""


def test_each_file_is_made_by_the_call_that_is_stated() -> None:
    assert set(shipped_calls()) == set(shipped())
    for name, call in shipped_calls().items():
        made: Any = eval(call, {"synthetic_lte": synthetic_lte, "drive_motion": drive_motion})
        if name.startswith("drive-"):
            assert np.array_equal(load_motion(name).coordinate, made.coordinate)
        else:
            assert np.array_equal(load(name).cumulative_bytes, made.cumulative_bytes)
        assert f"({name.split('-')[-1]}," in call  # the seed


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """The files of the wheel where pip would put them, as pyproject.toml says."""
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]["targets"][
        "wheel"
    ]
    site = tmp_path / "site"
    folders = {name: name for name in wheel["packages"]} | wheel["force-include"]
    for source, target in folders.items():
        shutil.copytree(ROOT / source, site / target, ignore=shutil.ignore_patterns("__pycache__", "*.nb[ic]"))
    return site


def test_the_commands_run_offline_from_what_the_wheel_holds(installed: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    # Compiling in a new place would take a minute, and what is tested here is which files are there.
    environment = {**os.environ, "PYTHONPATH": str(installed), "NUMBA_DISABLE_JIT": "1", "PYTHONSAFEPATH": "1"}
    command = [sys.executable, "-c", OFFLINE, str(installed)]
    done = subprocess.run(
        command, cwd=elsewhere, env=environment, input=COMMANDS.strip(), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    listed = done.stdout.split("> trace info")[0]
    assert all(name in listed for name in shipped())
    assert (elsewhere / "bench" / "table.md").is_file()
