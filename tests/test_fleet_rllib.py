"""The RLlib example, run as a user would: it needs the extra ``rllib``, whose Gymnasium is older than the others'."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parent.parent
MISSING = [name for name in ("ray", "tree", "ormsgpack", "torch", "pettingzoo") if not importlib.util.find_spec(name)]


@pytest.mark.slow
@pytest.mark.skipif(bool(MISSING), reason=f"the extra [rllib] is not installed: {', '.join(MISSING)} missing")
def test_the_example_learns_two_iterations() -> None:
    small = ["--robots", "2", "--iterations", "2", "--ticks", "400", "--seconds", "3"]
    command = [sys.executable, "examples/fleet_rllib.py", *small]
    done = subprocess.run(command, cwd=REPO, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    returns = re.findall(r"iteration \d: [1-9]\d* episodes, return ([\d.]+)", done.stdout)
    assert len(returns) == 2, done.stdout
    # The sum over two robots of H - 1, where V <= 1 and 90 frames arrive.
    assert all(0 < float(total) < 2 * 90 for total in returns)
