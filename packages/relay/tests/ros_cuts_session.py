"""A robot of ROS behind a link that is cut, for test_cuts.py: runs ``break_story``. Needs what ros_session does."""

import asyncio
import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from break_story import Done, story
from pose_cases import POSE, message
from relay_cases import wait
from ros_session import CONFIG, node_1, node_2

from bufgym_robot.wire import backoff

QUICK = "import sys; from bufgym_robot.wire import backoff; backoff.MOST_S = 0.05; from bufgym.cli import main; main()"
"""The command, which connects again soon."""


async def goal(operator: Any, x: float) -> None:
    await operator.command("/robots/r/to/goal_pose", message(POSE, 0, x, "map"), POSE)


async def cuts(version: str, folder: Path, count: int, seed: int) -> dict[str, int]:
    config = folder / "client.toml"
    config.write_text(CONFIG)
    done = Done()
    hear = {
        "speech": print,
        "initialpose": print,
        "goal_pose": lambda said: done.goal(said.pose.position.x),
        "cmd_vel": lambda said: done.moves(said.linear.x),
    }
    publishers = {"1": node_1, "2": node_2}[version](str(folder), hear)
    pytest.MonkeyPatch().setattr(backoff, "MOST_S", 0.05)  # for as long as this process lives
    async with story(done, goal) as (url, run):
        words = ["robot", "--to", url, "--name", "r", "--config", str(config), "--ros", version]
        words += ["--policies", "drop-oldest", "--receive", "goal_pose", "--receive", "cmd_vel"]
        robot = await asyncio.create_subprocess_exec(sys.executable, "-c", QUICK, *words, stdout=sys.stderr)
        try:
            return await run(count, seed)
        finally:
            robot.terminate()
            await wait("the robot's end", robot.wait())
            del publishers


if __name__ == "__main__":
    print(json.dumps(asyncio.run(cuts(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])))), flush=True)
    os._exit(0)
