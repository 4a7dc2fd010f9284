"""Robots of ROS at a relay: what a node publishes arrives byte by byte, and commands become messages of ROS."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
SEEN = {
    "exact": True,
    "kinds": [["cdr", "std_msgs/msg/String"]],
    "heard": [str(k) for k in range(8)],
    "location": {"x": 3.0, "y": 0.0, "yaw": 0.0},
}
"""Each command once and in order; nothing of what was broken, or meant for other topics."""


pytestmark = pytest.mark.nightly


@pytest.mark.parametrize("version", ["1", "2"])
def test_a_robot_of_ros(version: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    if version == "1":
        where = request.getfixturevalue("ros")
    else:
        pytest.importorskip("rclpy", reason="needs rclpy (extra ros2)")
        where = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    places = [where.get("PYTHONPATH", ""), str(HERE), str(HERE.parent), str(HERE.parents[1])]
    where = {**where, "PYTHONPATH": os.pathsep.join(filter(None, places))}
    words = [sys.executable, str(HERE / "ros_session.py"), version, str(tmp_path)]
    done = subprocess.run(words, env=where, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "not published" in done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == SEEN
