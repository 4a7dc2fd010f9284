"""Restarts and breaks of all parties at random moments, and what must be true of stops and goals whatever happens.

A robot, two operators and a relay with a folder, or two relays that share topics over NATS. Stops, releases and goals
are under way all the time. ``Truth`` notes when each was said and answered, and each thing that must not be.
"""

import asyncio
import contextlib
import json
import random
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import dataclass, field
from typing import Any

from cut_cases import Cuttable
from relay_cases import until, wait

from bufgym.utils.errors import BufgymError
from bufgym_live.relay.ledger import named
from bufgym_live.relay.orders import heard_stops
from bufgym_live.relay.robot import Robot
from bufgym_live.relay.session import Session

DEADLINE_S = 0.5
LATE_S = 0.8
"""An age at which no goal begins: its deadline, and what the test itself takes."""
OPEN = ("nobody knows", "withdrawn", "the client has ended")
"""Errors of a goal that was executed, or not: its sender said a stop or ended meanwhile, or nobody can tell."""


@dataclass
class Goal:
    """A goal, when it was sent, and its answer: empty if it was executed."""

    sent_s: float
    answer: str | None = None


@dataclass
class Said:
    """A stop: when ``stop`` returned, and when somebody began to release it and had done so."""

    returned_s: float
    begun_s: float | None = None
    released_s: float | None = None


@dataclass
class Truth:
    """What was said, what the robot did, and what must not be."""

    goals: dict[str, Goal] = field(default_factory=dict)
    stops: dict[str, Said] = field(default_factory=dict)
    released: list[str] = field(default_factory=list)
    """Stops of which somebody has begun the release."""
    begun: Counter[str] = field(default_factory=Counter)
    done: Counter[str] = field(default_factory=Counter)
    counts: Counter[str] = field(default_factory=Counter)
    wrong: list[str] = field(default_factory=list)

    def covered(self, ids: list[str]) -> list[Said]:
        """The stops that a release of these covers."""
        return [said for id, said in self.stops.items() if covers(ids, id)]

    def standing(self) -> list[str]:
        """The stops that returned, and of which nobody has begun the release."""
        return [id for id, said in self.stops.items() if said.begun_s is None]


def covers(ids: list[str], id: str) -> bool:
    """Whether one of these is the stop, or a later one of the same who."""
    who, number = named(id)
    return any(named(one)[0] == who and named(one)[1] >= number for one in ids)


class Body:
    """The robot's program, over all its restarts: a goal takes a moment."""

    streams = ()

    def __init__(self, truth: Truth, chance: random.Random) -> None:
        self._truth, self._chance = truth, chance
        self.robot: Robot | None = None

    async def run(self, robot: Robot) -> None:
        await asyncio.Event().wait()

    def status(self) -> dict[str, Any]:
        return {"commands": ["stop", "goal"]}

    async def on_command(self, command: Any) -> None:
        if command["command"] != "goal":
            return
        truth, id, now_s = self._truth, command["id"], time.monotonic()
        goal = truth.goals[id]
        truth.begun[id] += 1
        truth.counts["goals executed"] += 1
        if truth.begun[id] > 1:
            truth.wrong.append(f"twice: goal {id}")
        if now_s - goal.sent_s > LATE_S:
            truth.wrong.append(f"late: goal {id} after {now_s - goal.sent_s:.2f} s")
        if self.robot is not None and self.robot.latch.is_set:
            truth.wrong.append(f"goal {id} while a stop holds at the robot")
        for stop, said in truth.stops.items():
            if said.returned_s <= goal.sent_s and said.begun_s is None:
                truth.wrong.append(f"goal {id}, sent after stop {stop} returned, which nobody has released")
        if self._chance.random() < 0.3:
            await asyncio.sleep(self._chance.uniform(0, 0.1))
        truth.done[id] += 1


class Watch:
    """Somebody at a relay who watches all, and hears the robot's stops as relay and robot say them."""

    def __init__(self, url: str) -> None:
        self.session = Session(url, "watch")
        self.relay: list[str] = []
        self.robot: list[str] | None = None
        self.status: Any = None
        self.session.subscribe("^/robots/", self._heard)

    def _heard(self, message: Any) -> None:
        held = [stop.id for stop in heard_stops(message) if stop.holds]
        if message.topic == "/robots/r/stop":
            self.relay = sorted(held)
        elif message.topic == "/robots/r/status":
            said = json.loads(bytes(message.payload))
            if "stops" in said:
                self.robot, self.status = sorted(held), said.get("stop")

    def agrees(self, held: list[str]) -> bool:
        """Whether relay and status say what the robot knows."""
        return self.relay == self.robot == held and (self.status or {}).get("id", "") in (held or [""])


class Running:
    """A client's ``run`` that can be ended."""

    def __init__(self, work: Coroutine[Any, Any, None]) -> None:
        self._task = asyncio.create_task(work)

    async def end(self) -> None:
        self._task.cancel()
        await asyncio.wait([self._task])


class Field:
    """The parties. ``shakes`` are further events by name: restarts of relays, of NATS."""

    def __init__(self, links: tuple[Cuttable, Cuttable, Cuttable], watched: list[int], seed: int) -> None:
        """Links of the robot and of both operators; ``watched`` are the ports of the relays."""
        self.links, self.chance, self.truth = links, random.Random(seed), Truth()
        self.shakes: dict[str, Callable[[], Awaitable[Any]]] = {}
        self._body, self._waiting, self._number = Body(self.truth, self.chance), list[asyncio.Task[Any]](), 0
        self.watches = [Watch(f"ws://127.0.0.1:{port}") for port in watched]
        self._running: dict[str, Running] = {}
        self._ops: list[Session] = []

    async def __aenter__(self) -> "Field":
        for k, watch in enumerate(self.watches):
            self._running[f"watch {k}"] = Running(watch.session.run())
        for k in range(2):
            self._ops.append(self._operator(k))
        self._robot()
        self._running["monitor"] = Running(self._look())
        return self

    async def __aexit__(self, *_: object) -> None:
        for one in self._running.values():
            await one.end()

    def _operator(self, k: int) -> Session:
        one = Session(f"ws://127.0.0.1:{self.links[1 + k].port}", f"op{k}")
        self._running[f"op{k}"] = Running(one.run())
        return one

    def _robot(self) -> None:
        self.robot = Robot(f"ws://127.0.0.1:{self.links[0].port}", "r", self._body, policy="drop-oldest")
        self._body.robot = self.robot
        self._running["robot"] = Running(self.robot.run())

    async def _look(self) -> None:
        """A stop that the robot has confirmed holds there until somebody begins to release it, over all restarts."""
        confirmed = set[str]()
        while True:
            held = [stop.id for stop in self.robot.latch.ledger.held]
            confirmed |= {stop["id"] for stop in self.robot.status()["stops"] if "released_us" not in stop}
            for id in self.truth.standing():
                if id in confirmed and not covers(held, id):
                    self.truth.wrong.append(f"lost: stop {id} at the robot")
                    confirmed.discard(id)
            await asyncio.sleep(0.005)

    async def _send(self, operator: Session) -> str:
        self._number += 1
        id = f"g{self._number}"
        goal = self.truth.goals[id] = Goal(time.monotonic())
        self.truth.counts["goals"] += 1
        try:
            await operator.command("/robots/r/command", {"command": "goal", "id": id})
        except BufgymError as error:
            goal.answer = str(error)
        else:
            goal.answer = ""
            if not self.truth.done[id]:
                self.truth.wrong.append(f"acked: goal {id} was not executed")
        return goal.answer

    async def _stop(self, operator: Session) -> None:
        with contextlib.suppress(BufgymError):
            id = await operator.stop("r")
            now_s = time.monotonic()  # somebody may have released it before its answer came
            begun = now_s if covers(self.truth.released, id) else None
            self.truth.stops[id] = Said(now_s, begun)
            self.truth.counts["stops"] += 1

    async def _release(self, operator: Session, ids: list[str]) -> None:
        self.truth.released += ids
        for said in self.truth.covered(ids):
            said.begun_s = said.begun_s or time.monotonic()
        with contextlib.suppress(BufgymError):
            await operator.release("r", " ".join(ids))
            self.truth.counts["releases"] += 1
            for said in self.truth.covered(ids):
                said.released_s = said.released_s or time.monotonic()

    def _begin(self, work: Coroutine[Any, Any, Any]) -> None:
        self._waiting.append(asyncio.create_task(work))

    async def _shake(self) -> None:
        """One break, mend or restart."""
        chance = self.chance
        kind = chance.choice(["cut", "freeze", "mend", "robot", "operator", *self.shakes])
        self.truth.counts[kind] += 1
        match kind:
            case "cut" | "freeze" | "mend":
                getattr(chance.choice(self.links), kind)()
            case "robot":
                await self._running["robot"].end()
                self._robot()
            case "operator":
                k = chance.randrange(2)
                await self._running[f"op{k}"].end()
                self._ops[k] = self._operator(k)
            case _:
                await wait(kind, self.shakes[kind]())

    async def round(self) -> None:
        """Shakes with orders between them; then all meet, and what must hold is looked at."""
        chance = self.chance
        for _ in range(chance.randrange(1, 6)):
            for _ in range(chance.randrange(5)):
                operator, kind = chance.choice(self._ops), chance.random()
                if kind < 0.6:
                    self._begin(self._send(operator))
                elif kind < 0.8:
                    self._begin(self._stop(operator))
                elif held := chance.choice(self.watches).relay:
                    self._begin(self._release(operator, chance.sample(held, chance.randint(1, len(held)))))
                await asyncio.sleep(chance.uniform(0, 0.03))
            await self._shake()
            await asyncio.sleep(chance.choice([0.0, chance.uniform(0, 0.1), LATE_S * (chance.random() < 0.3)]))
        await self._meet()
        self.truth.counts["rounds"] += 1
        assert not self.truth.wrong, self.truth.wrong

    async def _meet(self) -> None:
        for link in self.links:
            link.mend()
        clients = [self.robot.client, *self._ops, *(watch.session for watch in self.watches)]
        await until("all are here", lambda: all(one.ready.is_set() for one in clients))
        await wait("all answers", asyncio.gather(*self._waiting))
        self._waiting.clear()
        await self._agree()
        held = self._held()
        lost = [id for id in self.truth.standing() if not covers(held, id)]
        self.truth.wrong += [f"lost: stop {id}" for id in lost]
        over = [id for id, said in self.truth.stops.items() if said.released_s is not None]
        self.truth.wrong += [f"back: stop {id}" for id in held if id in over]
        while held := self._held():
            await self._release(self.chance.choice(self._ops), held)
            await asyncio.sleep(0.02)
        for operator in self._ops:
            while why := await wait("a goal", self._send(operator)):
                self.truth.counts["tries"] += 1
                await asyncio.sleep(0.05)
                assert self.truth.counts["tries"] < 1000 * (1 + self.truth.counts["rounds"]), why
        await self._agree()
        self.truth.wrong += [f"back: stop {id}" for id in self._held()]
        for id, goal in self.truth.goals.items():
            if goal.answer and self.truth.done[id] and not any(words in goal.answer for words in OPEN):
                self.truth.wrong.append(f"refused, but executed: goal {id}: {goal.answer}")
        self.truth.goals.clear()
        self.truth.stops.clear()
        self.truth.released.clear()

    def _held(self) -> list[str]:
        return sorted(stop.id for stop in self.robot.latch.ledger.held)

    async def _agree(self) -> None:
        try:
            await until("all agree", lambda: all(watch.agrees(self._held()) for watch in self.watches))
        except TimeoutError:
            said = [(watch.relay, watch.robot, watch.status) for watch in self.watches]
            raise AssertionError(f"the robot has {self._held()}, others say {said}") from None
