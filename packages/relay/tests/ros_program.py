"""Programs of these tests that need ROS: each in a process of its own, with ROS 1 or 2."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from needs import needs

HERE = Path(__file__).resolve().parent
REPO = HERE.parents[2]
PACKAGES = REPO / "packages" / "robot", REPO / "packages" / "relay"
FOLDERS = HERE, PACKAGES[0] / "tests", *PACKAGES, REPO / "tests", REPO / "examples"


def run(request: pytest.FixtureRequest, name: str, version: str, *words: Any, limit_s: float = 600) -> tuple[Any, str]:
    """What such a program prints last, which is JSON, and its errors; the test is skipped where this ROS is not."""
    pytest.importorskip("rosbags", reason=needs("extras", "rosbags"))
    if version == "1":
        where = request.getfixturevalue("ros")
    else:
        pytest.importorskip("rclpy", reason=needs("ros2", "rclpy"))
        where = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    places = filter(None, [where.get("PYTHONPATH", ""), *map(str, FOLDERS)])
    command = [sys.executable, str(HERE / name), version, *map(str, words)]
    where = {**where, "PYTHONPATH": os.pathsep.join(places)}
    done = subprocess.run(command, env=where, capture_output=True, text=True, check=False, timeout=limit_s)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1]), done.stderr
