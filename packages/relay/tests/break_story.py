"""Breaks of the links of a robot and an operator at random moments: what any robot does, and what it must not do."""

import asyncio
import contextlib
import json
import random
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

from cut_cases import Cuttable, cuttable
from loop_cases import beside
from relay_cases import Client, client, relay, settings, until, wait

from bufgym.utils.errors import BufgymError
from bufgym_relay.config import Rule
from bufgym_robot.wire.session import Session

DEADLINE_S = 0.5
LONG_S = 0.8
"""A break in which each goal's deadline passes."""
RULE = Rule(address="127.0.0.0/8", send=True, receive=True, command_s=DEADLINE_S)
STATUS = "/robots/r/status"


class Done:
    """What a robot has executed: goals by their x, and velocities ahead, in order."""

    def __init__(self) -> None:
        self.events: list[tuple[str, float, float]] = []

    def goal(self, x: float) -> None:
        self.events.append(("goal", x, time.monotonic()))

    def moves(self, linear: float) -> None:
        self.events.append(("velocity", linear, time.monotonic()))

    def last_velocity(self) -> float:
        return next((value for kind, value, _ in reversed(self.events) if kind == "velocity"), 0.0)

    def motions(self, since: int = 0) -> list[tuple[str, float]]:
        """Goals, and velocities that are not zero."""
        return [(kind, value) for kind, value, _ in self.events[since:] if kind == "goal" or value]


class Story:
    """An operator sends goals and stops over one link, to a robot behind another; somebody holds a key all the time."""

    def __init__(self, done: Done, operator: Session, ann: Client, links: tuple[Cuttable, Cuttable], goal: Any) -> None:
        self._done, self._operator, self._ann, self._links, self._goal = done, operator, ann, links, goal
        self._status: dict[str, Any] = {}
        self._held = 0.3
        self._sent: dict[float, float] = {}
        self._never: set[float] = set()
        """Goals that must not be executed."""
        operator.subscribe(f"^{STATUS}$", self._heard)

    def _heard(self, message: Any) -> None:
        self._status = json.loads(bytes(message.payload))

    async def _hold(self) -> None:
        while True:
            velocity = {"linear": self._held, "angular": 0.0, "for_ms": 400}
            stamp_us = round(time.time() * 1e6)
            await self._ann.put(
                "/robots/r/drive", json.dumps(velocity).encode(), encoding="json", stamp_us=stamp_us, sender="ann"
            )
            await asyncio.sleep(0.05)

    async def _send(self, never: bool = False) -> str:
        """Send the next goal; return why it was refused."""
        x = (len(self._sent) + 1) / 1024
        self._sent[x] = time.monotonic()
        if never:
            self._never.add(x)
        try:
            await self._goal(self._operator, x)
        except BufgymError as error:
            return str(error)
        return ""

    async def run(self, cuts: int, seed: int) -> dict[str, int]:
        chance, waiting, stops = random.Random(seed), list[asyncio.Future[Any]](), 0
        async with beside(self._hold()):
            while await self._send():  # the robot has not subscribed yet
                await asyncio.sleep(0.1)
            await until("the key moves it", lambda: self._done.last_velocity() > 0)
            for k in range(cuts):
                link, is_cut, is_long, stopped = (
                    chance.choice(self._links),
                    chance.random() < 0.5,
                    chance.random() < 0.25,
                    k % 4 == 2,
                )
                waiting += [asyncio.ensure_future(self._send()) for _ in range(chance.randrange(2))]
                await asyncio.sleep(chance.uniform(0, 0.03))
                link.cut() if is_cut else link.freeze()
                never = is_long or (is_cut and stopped)
                waiting += [asyncio.ensure_future(self._send(never)) for _ in range(chance.randrange(3))]
                await asyncio.sleep(chance.uniform(0, 0.05))
                stop = asyncio.ensure_future(self._operator.stop("r")) if stopped else None
                if stopped:
                    await asyncio.sleep(0)  # the stop is under way, and the goal behind it
                    waiting.append(asyncio.ensure_future(self._send(never=True)))
                await asyncio.sleep(LONG_S if is_long else chance.uniform(0, 0.1))
                link.mend()
                if stop is not None:
                    stops += 1
                    await self._stands_until_released(await wait("the stop", stop))
            await wait("all goals", asyncio.gather(*waiting))
            while await self._send():  # the link was cut a moment ago
                await asyncio.sleep(0.1)
            last = len(self._sent) / 1024
            await until("the last goal", lambda: ("goal", last) in self._done.motions())
        goals = [(x, at_s - self._sent[x]) for kind, x, at_s in self._done.events if kind == "goal"]
        assert not self._never & {x for x, _ in goals}
        assert max(age_s for _, age_s in goals) < LONG_S, goals
        assert len(goals) == len({x for x, _ in goals}), "a goal was executed twice"
        return {"cuts": cuts, "stops": stops}

    async def _stands_until_released(self, id: str) -> None:
        """The key is held all the time: it moves nothing until it was let go, after somebody has released the stop."""
        await until("it stands", lambda: (self._status.get("stop") or {}).get("id") == id)
        await until("zeros", lambda: self._done.last_velocity() == 0)
        await asyncio.sleep(0.1)
        since = len(self._done.events)
        await asyncio.sleep(0.2)
        while self._status.get("stop"):
            with contextlib.suppress(BufgymError):
                await wait("the release", self._operator.release("r", id))
            await asyncio.sleep(0.1)
        await asyncio.sleep(0.3)
        assert self._done.motions(since) == []
        self._held = 0.0
        await asyncio.sleep(0.3)
        self._held = 0.3
        await until("the key moves it", lambda: self._done.last_velocity() > 0)


@contextlib.asynccontextmanager
async def story(
    done: Done, goal: Callable[[Session, float], Awaitable[None]]
) -> AsyncIterator[tuple[str, Callable[[int, int], Awaitable[dict[str, int]]]]]:
    """The address at which the robot ``r`` connects, and what runs the story of so many cuts with a seed."""
    kept = settings(rules=(RULE,), no_drop=("/robots/[^/]+/(command|to/.*)",))
    async with relay(kept) as server, cuttable(server.port) as near, cuttable(server.port) as far:
        operator = Session(f"ws://127.0.0.1:{near.port}", "operator")
        async with client(server.port, name="ann") as ann:
            one = Story(done, operator, ann, (near, far), goal)
            async with beside(operator.run()):
                yield f"ws://127.0.0.1:{far.port}", one.run
