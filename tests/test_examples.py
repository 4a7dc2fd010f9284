"""Examples run, with tiny settings."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parent.parent


def test_imitation_prints_its_score_beside_afrs() -> None:
    pytest.importorskip("torch")
    settings = ["--rounds", "2", "--episodes", "4", "--epochs", "1"]
    command = [sys.executable, "examples/imitation.py", *settings]
    done = subprocess.run(command, cwd=REPO, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "round 2: 2,400 states" in done.stdout
    assert re.search(r"score of this network: -?[0-9.]+\nscore of afr: 0.[0-9]+", done.stdout)
