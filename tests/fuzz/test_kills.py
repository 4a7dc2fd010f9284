"""Killed at any moment, the run of a suite goes on, and ends as if nothing had been.

In a commit's tests, without processes: `test_a_run_that_was_killed_goes_on_where_it_was` in benchmark/test_sweep.py
and, for a training, `test_a_killed_run_goes_on_from_its_checkpoint` in test_train.py.
"""

import os
import random
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from mutations import SEED

pytestmark = pytest.mark.nightly

REPO = Path(__file__).resolve().parents[2]
KILLS = 3
SUITE = "--suite interruption-v1 --policies afr,random,drop-oldest --capacity 2,4 --seeds 3 --jobs 2 --format csv --out"


def ended(command: list[str], home: Path, kill_after_s: float | None) -> bool:
    """Whether the command came to its end; else it was killed, alone or with all that it began."""
    told: Any = {"stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    environment = {**os.environ, "PYTHONPATH": str(REPO), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen([sys.executable, *command], cwd=home, env=environment, **told)
    try:
        _, said = process.communicate(timeout=kill_after_s)
    except subprocess.TimeoutExpired:
        process.kill() if kill_after_s and int(1000 * kill_after_s) % 2 else os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return False
    assert process.returncode == 0, said
    return True


def test_the_run_of_a_suite(tmp_path: Path) -> None:
    pytest.importorskip("joblib", reason="a sweep needs joblib")
    command = ["-m", "bufgym", "bench", *SUITE.split()]
    assert ended([*command, "whole"], tmp_path, None)
    uniform, kills, number = random.Random(f"{SEED}-kills"), 0, 0
    while kills < KILLS:
        number += 1
        while not ended([*command, f"{number}"], tmp_path, uniform.uniform(0.1, 8) if kills < KILLS else None):
            kills += 1
        rows = [(tmp_path / name / "rows.csv").read_bytes() for name in ("whole", f"{number}")]
        assert rows[0] == rows[1] and not (tmp_path / f"{number}" / "parts").exists()
