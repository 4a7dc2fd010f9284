"""A robot of ROS that is restarted, killed and cut off, for test_restarts.py. Needs what ros_session does.

The robot is a process of its own, and what it executes is what a node of the test's own hears.
"""

import asyncio
import json
import os
import random
import signal
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from pose_cases import POSE, message
from relay_cases import settings, wait
from restart_cases import RULE, begun, play, played
from restart_truth import DEADLINE_S, Truth, covers
from ros_cuts_session import QUICK
from ros_session import CONFIG, node_1, node_2

from bufgym_relay import claims
from bufgym_robot.fleet.kept import place
from bufgym_robot.wire import backoff
from bufgym_robot.wire.ledger import read
from bufgym_robot.wire.session import Session
from bufgym_robot.wire.sockets import free_port

SLOW_S = 1.5
"""Longest way of a message through ROS to the node, on a busy machine."""
UNIT = 1024
"""Goal number k has x = k / 1024, which is exact."""


class Process:
    """A robot of ROS in a process of its own. Its stops are read from its file."""

    start_s, latency_s = 6.0, 2.0

    def __init__(self, version: str, folder: Path, truth: Truth, chance: random.Random, url: str) -> None:
        config = folder / "client.toml"
        config.write_text(CONFIG)
        words = ["robot", "--to", url, "--name", "r", "--config", str(config), "--ros", version]
        words += ["--policies", "drop-oldest", "--receive", "goal_pose", "--receive", "cmd_vel"]
        self._words, self._file, self._truth = words, place(urlsplit(url).netloc, "r"), truth
        self._held: dict[str, float] = {}
        """Stop in the file -> when it was first seen there."""
        self._since_s = 0.0
        truth.late_s = DEADLINE_S + SLOW_S
        self.restarts = {
            "robot ended": partial(self._again, signal.SIGTERM),
            "robot killed": partial(self._again, signal.SIGKILL),
        }
        hear = {
            "speech": print,
            "initialpose": print,
            "goal_pose": self._from_ros(self._goal, lambda said: said.pose.position.x),
            "cmd_vel": self._from_ros(self._velocity, lambda said: said.linear.x),
        }
        self._node = {"1": node_1, "2": node_2}[version](str(folder), hear)

    def _from_ros(self, tell: Callable[[float, float], None], read: Callable[[Any], float]) -> Callable[[Any], None]:
        """What ROS calls, in its own thread, with a message: the loop is told the number and when it was heard."""
        loop = asyncio.get_running_loop()
        return lambda said: void(loop.call_soon_threadsafe(tell, read(said), time.monotonic()))

    def _goal(self, x: float, heard_s: float) -> None:
        id = f"g{round(x * UNIT)}"
        sent = self._truth.goals.get(id)
        # A stop may come, and be written, while the goal is under way in ROS: so it must have been there for long.
        self._truth.began(id, heard_s, self._stood(max(heard_s - SLOW_S, sent.sent_s if sent else 0.0)))
        self._truth.done[id] += 1

    def _velocity(self, linear: float, heard_s: float) -> None:
        self._truth.moved(linear, self._stood(heard_s - SLOW_S))

    def _stood(self, since_s: float) -> bool:
        """Whether a stop has held since then which nobody has begun to release."""
        self.held()
        return any(at_s < since_s and not covers(self._truth.released, id) for id, at_s in self._held.items())

    async def begin(self) -> None:
        self._since_s = time.monotonic()
        words = [sys.executable, "-c", QUICK, *self._words]
        self._process = await asyncio.create_subprocess_exec(*words, stdout=sys.stderr)

    async def end(self, how: signal.Signals = signal.SIGTERM) -> None:
        if self._process.returncode is None:
            self._process.send_signal(how)
        await wait("the robot's end", self._process.wait())

    async def _again(self, how: signal.Signals) -> None:
        self.is_here(0.0)
        await self.end(how)
        await self.begin()

    def is_here(self, status_s: float) -> bool:
        assert self._process.returncode is None, "the robot has ended by itself"
        return status_s > self._since_s

    def held(self) -> list[str]:
        if self._file.exists():
            stops, seen_s = read(json.loads(self._file.read_bytes())["stops"]), time.monotonic()
            self._held = {stop.id: self._held.get(stop.id, seen_s) for stop in stops if stop.holds}
        return sorted(self._held)

    def confirmed(self) -> set[str]:
        """What is written must hold, whether somebody has heard so or not."""
        return set(self.held())

    async def send(self, operator: Session, id: str) -> None:
        pose = message(POSE, 0, int(id[1:]) / UNIT, "map")
        await operator.command("/robots/r/to/goal_pose", pose, POSE)


def void(_: object) -> None:
    """Nothing: rospy wants no answer."""


async def restarts(version: str, folder: Path, rounds: int, seed: int) -> dict[str, int]:
    changed = pytest.MonkeyPatch()  # for as long as this process lives
    changed.setattr(backoff, "MOST_S", 0.05)
    changed.setattr(claims, "SILENT_S", 1.0)
    changed.setenv("XDG_STATE_HOME", str(folder / "state"))
    port = free_port("127.0.0.1")
    no_drop = ("/robots/[^/]+/(command|to/.*)",)
    config = settings(port=port, rules=(RULE,), folder=folder / "relay", no_drop=no_drop)
    async with begun(config) as one, played(port, port, seed, partial(Process, version, folder)) as field:
        field.shakes["relay"] = one.again
        return await play(field, rounds, seed, ["robot ended", "robot killed"])


if __name__ == "__main__":
    done = asyncio.run(restarts(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])))
    print(json.dumps(done), flush=True)
    os._exit(0)
