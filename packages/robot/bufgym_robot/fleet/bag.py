"""A recording played as a robot: its messages are sent again with their recorded spacing."""

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bufgym.model.topics import Topic
from bufgym.scenario import Stream
from bufgym.traces.formats.bags import messages, read_bag
from bufgym.utils.errors import BufgymError
from bufgym_robot.fleet.robot import Robot
from bufgym_robot.wire import ros_messages

_LATE_S = 1.0  # delay beyond which playback does not catch up but continues from the present


class BagSource:
    """The recording in ``path``, an MCAP file, a ROS 1 bag or a rosbag2; ``loops`` repeats it.

    ``streams`` selects topics and gives their rules; None plays all topics without rules.
    """

    def __init__(self, path: str | Path, streams: Sequence[Stream] | None = None, *, loops: bool = True) -> None:
        bag = read_bag(path)
        if not len(bag.time_ns):
            raise BufgymError(f"{path}: has no messages")
        counts = dict(zip(bag.topics, np.bincount(bag.topic, minlength=len(bag.topics)).tolist(), strict=True))
        if streams is None:
            seconds = max(1.0, float(bag.time_ns[-1] - bag.time_ns[0]) / 1e9)
            rates_hz = {name.lstrip("/"): count / seconds for name, count in counts.items() if count}
            streams = tuple(Stream(Topic(name), rate_hz, 1000) for name, rate_hz in rates_hz.items())
        self._bag, self.streams, self._loops = bag, streams, loops
        self._names = {f"/{stream.topic.name.lstrip('/')}": stream.topic.name for stream in streams}
        self._counts = counts
        for name in self._names:
            self._has(name)

    def _has(self, name: str) -> None:
        if not self._counts.get(name):
            raise BufgymError(f"{self._bag.path}: no messages of topic {name!r}; it has: {', '.join(self._counts)}")

    async def run(self, robot: Robot) -> None:
        if robot.place.topic:
            self._has(f"/{robot.place.topic}")
        while True:
            await self._play(robot)
            if not self._loops:
                return

    async def _play(self, robot: Robot) -> None:
        loop = asyncio.get_running_loop()
        offset_s: float | None = None
        for channel, logged_ns, payload in messages(self._bag):
            name, odometry = self._names.get(channel.topic), robot.place.topic
            if name is None and channel.topic.lstrip("/") != odometry:
                continue
            if offset_s is None or loop.time() - logged_ns / 1e9 - offset_s > _LATE_S:
                offset_s = loop.time() - logged_ns / 1e9
            await asyncio.sleep(offset_s + logged_ns / 1e9 - loop.time())
            encoding, payload = ros_messages.modern(payload, channel.type, channel.encoding or "json")
            if name is None:
                robot.place.take(odometry, payload, channel.type, encoding)
            else:
                robot.publish(name, payload, encoding, channel.type)

    def status(self) -> dict[str, Any]:
        return {"recording": Path(self._bag.path).name}

    async def on_command(self, command: Any) -> None:
        """Refuse the command, because a recording cannot change."""
        raise BufgymError(f"command {str(command)[:60]}: this robot is a recording, which takes none")
