"""Robots of ROS at a relay: what a node publishes arrives byte by byte, and commands become messages of ROS."""

from __future__ import annotations

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).resolve().parent
SEEN = {
    "exact": True,
    "kinds": [["cdr", "std_msgs/msg/String"]],
    "heard": [str(k) for k in range(8)],
    "location": {"x": 3.0, "y": 0.0, "yaw": 0.0},
}
"""Each command once and in order; nothing of what was broken, or meant for other topics."""


def session(version: str, folder: Path, where: dict[str, str]) -> Any:
    places = [*where.get("PYTHONPATH", "").split(os.pathsep), str(HERE), str(HERE.parents[1])]
    where = {**where, "PYTHONPATH": os.pathsep.join(filter(None, places))}
    words = [sys.executable, str(HERE / "ros_session.py"), version, str(folder)]
    done = subprocess.run(words, env=where, capture_output=True, text=True, check=False, timeout=150)
    assert done.returncode == 0, done.stderr
    assert "not published" in done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_a_robot_of_ros_1(ros: dict[str, str], tmp_path: Path) -> None:
    assert session("1", tmp_path, ros) == SEEN


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="needs rclpy (extra ros2)")
def test_a_robot_of_ros_2(tmp_path: Path) -> None:
    assert session("2", tmp_path, {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}) == SEEN
