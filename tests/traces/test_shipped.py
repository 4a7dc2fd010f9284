"""What comes with bufgym: made by the calls that are stated, and enough to run every command without a network."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bufgym.errors import BufgymError, TraceError
from bufgym.traces import drive_motion, load, load_motion, shipped, synthetic_lte
from bufgym.traces.generate.shipped import shipped_calls

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
trace generate link --mode tram --duration 60 -o tram.csv
bench --seconds 1 --fps 10 --seeds 1 --capacity 2 --policies afr,drop-oldest --format csv --out bench
"""


def test_each_file_is_made_by_the_call_that_is_stated() -> None:
    assert set(shipped_calls()) == set(shipped())
    for name, call in shipped_calls().items():
        generated: Any = eval(call, {"synthetic_lte": synthetic_lte, "drive_motion": drive_motion})
        if name.startswith("drive-"):
            assert np.array_equal(load_motion(name).coordinate, generated.coordinate)
        else:
            assert np.array_equal(load(name).cumulative_bytes, generated.cumulative_bytes)
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


def test_what_reads_as_a_trace_loads(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "logs.zip", "w") as archive:
        for name in ("bus/a.csv", "bus/b.csv"):
            archive.writestr(
                name, "Timestamp,DL_bitrate,UL_bitrate\n2020.01.01_00.00.00,8,16\n2020.01.01_00.00.01,8,16\n"
            )
    member = f"{tmp_path / 'logs.zip'}:a.csv"
    assert load(member, column="UL_bitrate").total_bytes == 2 * load(member).total_bytes > 0
    with pytest.raises(TraceError, match=r"c\.csv.*must be one of its 2 members"):
        load(f"{tmp_path / 'logs.zip'}:c.csv")
    with pytest.raises(TraceError, match=r"no\.zip:a\.csv: no such file, and no shipped trace"):
        load(f"{tmp_path / 'no.zip'}:a.csv")
    with pytest.raises(BufgymError, match="format csv has no columns to choose from"):
        load("lte-synthetic-0", column="UL_bitrate")
