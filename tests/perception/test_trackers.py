"""The comparison of trackers runs on the made-up room, and each tracker follows slow frames to the end."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("small_gicp", reason="small_gicp, which is compared with, is not installed")
REPO = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_every_tracker_follows_slow_frames() -> None:
    command = [sys.executable, "examples/trackers.py", "--frames", "9", "--every", "2"]
    environment = {**os.environ, "PYTHONPATH": str(REPO)}
    done = subprocess.run(command, cwd=REPO, env=environment, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert [line.split()[2:6] for line in done.stdout.splitlines()[1:]] == [
        [name, "5", "of", "5"] for name in ("bufgym", "cv2.Odometry", "small_gicp")
    ]
