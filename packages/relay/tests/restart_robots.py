"""The story's robot: what any can be told and asked, and the one in the test's own loop."""

import asyncio
import random
import time
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, Protocol

from restart_truth import Truth

from bufgym_robot.fleet.robot import Robot
from bufgym_robot.wire.session import Session


class Running:
    """A client's ``run`` that can be ended."""

    def __init__(self, work: Any) -> None:
        self._task = asyncio.create_task(work)

    async def end(self) -> None:
        """End it; raise what it ended with before, if it did."""
        self._task.cancel()
        await asyncio.wait([self._task])
        if not self._task.cancelled():
            self._task.result()


class Played(Protocol):
    """A robot ``r`` that is restarted, and tells the ``Truth`` what it does."""

    restarts: Mapping[str, Callable[[], Awaitable[None]]]
    """The ways in which it restarts."""
    start_s: float
    """Time from a restart until it is usually at the relay again."""
    latency_s: float
    """Time from when a goal is executed, as its receipt says, until ``Truth`` knows, at most."""

    async def begin(self) -> None: ...

    async def end(self) -> None: ...

    def is_here(self, status_s: float) -> bool:
        """Whether it is at the relay; somebody heard its last status at ``status_s``."""

    def held(self) -> list[str]:
        """The stops that it holds, sorted."""

    def confirmed(self) -> set[str]:
        """The stops that it has confirmed by now, and that hold."""

    async def send(self, operator: Session, id: str) -> None:
        """Have an operator send it the goal with this id; raise a BufgymError if it was not executed."""


class Body:
    """The program of a robot in the test's loop, over all its restarts: a goal takes a moment."""

    streams = ()

    def __init__(self, truth: Truth, chance: random.Random) -> None:
        self._truth, self._chance = truth, chance
        self.robot: Robot | None = None

    async def run(self, robot: Robot) -> None:
        await asyncio.Event().wait()

    def status(self) -> dict[str, Any]:
        return {"commands": ["stop", "goal", "drive"]}

    async def on_command(self, command: Any) -> None:
        stands = self.robot is not None and self.robot.latch.is_set
        if command["command"] in ("drive", "stop"):
            self._truth.moved(command.get("linear", 0.0), stands)
        if command["command"] != "goal":
            return
        self._truth.began(command["id"], time.monotonic(), stands)
        if self._chance.random() < 0.3:
            await asyncio.sleep(self._chance.uniform(0, 0.1))
        self._truth.done[command["id"]] += 1


class Within:
    """A robot in the test's own loop."""

    start_s = latency_s = 0.0

    def __init__(self, truth: Truth, chance: random.Random, url: str) -> None:
        self._body, self._url = Body(truth, chance), url
        self.restarts = {"robot": self._again}

    async def begin(self) -> None:
        self._robot = Robot(self._url, "r", self._body, policy="drop-oldest")
        self._body.robot = self._robot
        self._running = Running(self._robot.run())

    async def end(self) -> None:
        await self._running.end()

    async def _again(self) -> None:
        await self.end()
        await self.begin()

    def is_here(self, status_s: float) -> bool:
        return self._robot.client.ready.is_set()

    def held(self) -> list[str]:
        return sorted(stop.id for stop in self._robot.latch.ledger.held)

    def confirmed(self) -> set[str]:
        return {stop["id"] for stop in self._robot.status()["stops"] if "released_us" not in stop}

    async def send(self, operator: Session, id: str) -> None:
        await operator.command("/robots/r/command", {"command": "goal", "id": id})
