"""Killed at any moment, the run of a suite and a training go on, and end as if nothing had been.

`make fuzz` has 100 kills of each, every day there is one.
"""

from __future__ import annotations

import csv
import importlib.util
import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from mutations import COUNT, SEED

REPO = Path(__file__).resolve().parents[2]
KILLS = max(1, COUNT // 1000)
SUITE = ["--suite", "interruption-v1", "--policies", "afr,random,drop-oldest", "--capacity", "2,4", "--seeds", "3"]
TRAINING = ["--steps", "1280", "--num-envs", "4", "--n-steps", "32", "--batch-size", "64", "--epochs", "1"]
TRAINING += ["--name", "fuzz", "--capacity", "3", "--duration-s", "1", "--episodes", "3", "--checkpoint-every", "128"]


def ended(command: list[str], home: Path, kill_after_s: float | None) -> bool:
    """Whether the command came to its end; else it was killed, with all that it began."""
    process = subprocess.Popen(
        [sys.executable, *command],
        cwd=home,
        env={**os.environ, "PYTHONPATH": str(REPO), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        _, told = process.communicate(timeout=kill_after_s)
    except subprocess.TimeoutExpired:
        process.kill() if kill_after_s and int(1000 * kill_after_s) % 2 else os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return False
    assert process.returncode == 0, told
    return True


@pytest.mark.slow
def test_the_run_of_a_suite(tmp_path: Path) -> None:
    pytest.importorskip("joblib", reason="a sweep needs joblib")

    def command(out: str) -> list[str]:
        return ["-m", "bufgym", "bench", *SUITE, "--jobs", "2", "--format", "csv", "--out", out]

    assert ended(command("whole"), tmp_path, None)
    expected = (tmp_path / "whole" / "rows.csv").read_bytes()
    uniform, kills, number = random.Random(f"{SEED}-kills"), 0, 0
    while kills < KILLS:
        number += 1
        while not ended(command(str(number)), tmp_path, uniform.uniform(0.1, 8) if kills < KILLS else None):
            kills += 1
        assert (tmp_path / str(number) / "rows.csv").read_bytes() == expected
        assert not (tmp_path / str(number) / "parts").exists()


@pytest.mark.slow
def test_a_training(tmp_path: Path) -> None:
    for extra in ("torch", "tyro", "matplotlib"):
        if importlib.util.find_spec(extra) is None:
            pytest.skip("the extras [train] and [plot] are not installed")
    uniform, kills = random.Random(f"{SEED}-training"), 0
    home = tmp_path / "runs" / "fuzz"
    while True:
        resume = ["--resume"] if (home / "settings.json").exists() else []
        after_s = uniform.uniform(1, 20) if kills < KILLS else None
        if ended([str(REPO / "train.py"), *TRAINING, *resume], tmp_path, after_s) and after_s is None:
            break
        kills += 1
    assert (home / "results.json").exists()
    with (home / "seed-0" / "curve.csv").open(encoding="utf-8") as file:
        assert [int(float(row["steps"])) for row in csv.DictReader(file)] == list(range(128, 1_281, 128))
