"""A made-up robot that drives through a made-up room, with odometry, a laser, a camera and a battery."""

from __future__ import annotations

import asyncio
import math
import time
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np

from bufgym.relay import ros_messages
from bufgym.relay.robot import Robot
from bufgym.relay.room import cast, jpeg, picture, pose_at
from bufgym.scenario import Stream, read_client

CONFIG: Final = Path(str(files("bufgym.relay").joinpath("madeup.toml")))
"""Configuration of its topics, in the format of a client's."""
BEAMS: Final = np.radians(np.arange(-180, 180, 2.0))
_DRAIN_S: Final = 3600.0
"""Time for a full battery to run empty."""
_TURN_S: Final = 0.05


class MadeUp:
    """The ``number``-th made-up robot, a source for a ``Robot``: its topics are ``odom``, ``scan`` and ``camera``."""

    def __init__(self, number: int = 0, streams: tuple[Stream, ...] | None = None) -> None:
        self.number = number
        self.streams = read_client(CONFIG).streams if streams is None else streams
        self._began_s = time.monotonic()

    async def run(self, robot: Robot) -> None:
        makers = {"odom": self._odometry, "scan": self._scan, "camera": self._camera}
        due_s = {stream.topic.name: self._began_s for stream in self.streams if stream.topic.name in makers}
        period_s = {stream.topic.name: 1 / stream.rate_hz for stream in self.streams}
        while True:
            now_s = time.monotonic()
            for name in due_s:
                if due_s[name] <= now_s:
                    due_s[name] = max(due_s[name] + period_s[name], now_s - _TURN_S)
                    makers[name](robot)
            await asyncio.sleep(max(0.0, min(due_s.values()) - time.monotonic()))

    def _odometry(self, robot: Robot) -> None:
        now_s, now_us = self._now()
        pose, later = pose_at(self.number, now_s), pose_at(self.number, now_s + 0.1)
        speed_m_s = math.hypot(later.x - pose.x, later.y - pose.y) / 0.1
        robot.publish("odom", ros_messages.odometry(now_us, robot.name, pose, speed_m_s), "cdr", ros_messages.ODOMETRY)

    def _scan(self, robot: Robot) -> None:
        now_s, now_us = self._now()
        ranges_m = cast(pose_at(self.number, now_s), BEAMS)[0]
        robot.publish("scan", ros_messages.scan(now_us, robot.name, BEAMS, ranges_m), "cdr", ros_messages.SCAN)

    def _camera(self, robot: Robot) -> None:
        robot.publish("camera", jpeg(picture(pose_at(self.number, self._now()[0]))), "jpeg")

    def _now(self) -> tuple[float, int]:
        """Return the time in s since it began and in us since 1970."""
        return time.monotonic() - self._began_s, time.time_ns() // 1000

    def status(self) -> dict[str, Any]:
        charge = 1 - 0.13 * (self.number % 5) - self._now()[0] / _DRAIN_S
        return {"battery": round(max(0.0, charge), 3)}

    async def on_command(self, command: Any) -> None:
        """Ignore the command; this robot knows none."""
