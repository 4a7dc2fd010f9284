"""Restarts and breaks of all parties at random moments, and what must be true of stops and goals whatever happens.

A robot, two operators and a relay with a folder, or two relays that share topics over NATS. Stops, releases and goals
are under way all the time. ``Truth`` notes when each was said and answered, and each thing that must not be.
"""

import asyncio
import contextlib
import json
import random
import time
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from typing import Any

from cut_cases import Cuttable
from relay_cases import client, until, wait
from restart_robots import Played, Running, Within
from restart_truth import LATE_S, OPEN, Goal, Said, Truth, covers
from websockets.exceptions import WebSocketException

from bufgym.utils.errors import BufgymError
from bufgym_robot.wire.orders import heard_stops
from bufgym_robot.wire.session import Session

STANDS_S = 20.0
"""Time in which a robot that holds a stop stands, once all have met."""
Make = Callable[[Truth, random.Random, str], Played]
"""Makes the robot, which connects to this address."""


class Watch:
    """Somebody at a relay who watches all, and hears the robot's stops as relay and robot say them."""

    def __init__(self, url: str) -> None:
        self.session = Session(url, "watch")
        self.relay: list[str] = []
        self.robot: list[str] | None = None
        self.status: Any = None
        self.status_s = 0.0
        """When it heard the robot's last status."""
        self.session.subscribe("^/robots/", self._heard)

    def _heard(self, message: Any) -> None:
        held = [stop.id for stop in heard_stops(message) if stop.holds]
        if message.topic == "/robots/r/stop":
            self.relay = sorted(held)
        elif message.topic == "/robots/r/status":
            said = json.loads(bytes(message.payload))
            if "stops" in said:
                self.robot, self.status = sorted(held), said.get("stop")
                self.status_s = time.monotonic()

    def agrees(self, held: list[str]) -> bool:
        """Whether relay and status say what the robot knows."""
        return self.relay == self.robot == held and (self.status or {}).get("id", "") in (held or [""])


class Field:
    """The parties. ``shakes`` are further events by name: restarts of relays, of NATS."""

    def __init__(self, links: Sequence[Cuttable], watched: list[int], seed: int, make: Make = Within) -> None:
        """Links of the robot and of both operators; ``watched`` are the ports of the relays."""
        self.links, self.chance, self.truth = links, random.Random(seed), Truth()
        self.shakes: dict[str, Callable[[], Awaitable[Any]]] = {}
        self._robot = make(self.truth, self.chance, f"ws://127.0.0.1:{links[0].port}")
        self._waiting, self._number = list[asyncio.Task[Any]](), 0
        self._watched = watched[0]
        self.watches = [Watch(f"ws://127.0.0.1:{port}") for port in watched]
        self._running: dict[str, Running] = {}
        self._ops: list[Session] = []

    async def __aenter__(self) -> "Field":
        for k, watch in enumerate(self.watches):
            self._running[f"watch {k}"] = Running(watch.session.run())
        for k in range(2):
            self._ops.append(self._operator(k))
        await self._robot.begin()
        self._running["monitor"] = Running(self._look())
        self._running["driver"] = Running(self._hold_keys(self._watched))
        return self

    async def __aexit__(self, *_: object) -> None:
        for one in self._running.values():
            await one.end()
        await self._robot.end()

    def _operator(self, k: int) -> Session:
        one = Session(f"ws://127.0.0.1:{self.links[1 + k].port}", f"op{k}")
        self._running[f"op{k}"] = Running(one.run())
        return one

    async def _hold_keys(self, port: int) -> None:
        """Somebody at a relay drives all the time, and lets the key go twice a second."""
        while True:
            with contextlib.suppress(OSError, EOFError, WebSocketException):
                async with client(port, name="ann") as ann:
                    for k in range(10**9):
                        said = {"linear": 0.3 * (k % 10 < 7), "angular": 0.0, "for_ms": 200}
                        stamp_us, payload = round(time.time() * 1e6), json.dumps(said).encode()
                        await ann.put("/robots/r/drive", payload, encoding="json", stamp_us=stamp_us, sender="ann")
                        await asyncio.sleep(0.05)
            await asyncio.sleep(0.05)

    async def _look(self) -> None:
        """A stop that the robot has confirmed holds there until somebody begins to release it, over all restarts."""
        confirmed = set[str]()
        while True:
            held = self._robot.held()
            confirmed |= self._robot.confirmed().union(*(watch.robot or () for watch in self.watches))
            for id in self.truth.standing():
                if id in confirmed and not covers(held, id):
                    said = [(watch.relay, watch.robot) for watch in self.watches]
                    self.truth.wrong.append(
                        f"lost: stop {id} at the robot, which holds {held}; relay and status: {said}"
                    )
                    confirmed.discard(id)
            await asyncio.sleep(0.005)

    async def _send(self, operator: Session) -> str:
        self._number += 1
        id = f"g{self._number}"
        goal = self.truth.goals[id] = Goal(time.monotonic())
        self.truth.counts["goals"] += 1
        try:
            await self._robot.send(operator, id)
        except BufgymError as error:
            goal.answer = str(error)
        else:
            goal.answer = ""
            until_s = time.monotonic() + self._robot.latency_s
            while not self.truth.done[id] and time.monotonic() < until_s:
                await asyncio.sleep(0.005)
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

    async def _shake(self, kind: str = "") -> None:
        """One break, mend or restart, drawn at random unless it is given."""
        chance, restarts = self.chance, self._robot.restarts
        kind = kind or chance.choice(["cut", "freeze", "mend", *restarts, "operator", *self.shakes])
        self.truth.counts[kind] += 1
        match kind:
            case "cut" | "freeze" | "mend":
                getattr(chance.choice(self.links), kind)()
            case _ if kind in restarts:
                await wait(kind, restarts[kind]())
                until_s = time.monotonic() + self._robot.start_s * (chance.random() < 0.5)
                while not self._is_here() and time.monotonic() < until_s:
                    await asyncio.sleep(0.02)
            case "operator":
                k = chance.randrange(2)
                await self._running[f"op{k}"].end()
                self._ops[k] = self._operator(k)
            case _:
                await wait(kind, self.shakes[kind]())

    async def round(self, first: str = "") -> None:
        """Shakes, of which the first may be given, with orders between them; then all meet, and nothing is wrong."""
        chance = self.chance
        for k in range(chance.randrange(1, 6)):
            for _ in range(chance.randrange(5)):
                operator, kind = chance.choice(self._ops), chance.random()
                if kind < 0.6:
                    self._begin(self._send(operator))
                elif kind < 0.8:
                    self._begin(self._stop(operator))
                elif held := chance.choice(self.watches).relay:
                    self._begin(self._release(operator, chance.sample(held, chance.randint(1, len(held)))))
                await asyncio.sleep(chance.uniform(0, 0.03))
            await self._shake(first if k == 0 else "")
            await asyncio.sleep(chance.choice([0.0, chance.uniform(0, 0.1), LATE_S * (chance.random() < 0.3)]))
        await self._meet()
        self.truth.counts["rounds"] += 1
        assert not self.truth.wrong, self.truth.wrong

    async def _meet(self) -> None:
        for link in self.links:
            link.mend()
        clients = [*self._ops, *(watch.session for watch in self.watches)]
        await until("all are here", lambda: self._is_here() and all(one.ready.is_set() for one in clients))
        await wait("all answers", asyncio.gather(*self._waiting))
        self._waiting.clear()
        await self._agree()
        held = self._robot.held()
        until_s = time.monotonic() + STANDS_S
        while held and self.truth.linear and time.monotonic() < until_s:
            await asyncio.sleep(0.01)
        if held and self.truth.linear:
            self.truth.wrong.append(f"moves on at {self.truth.linear}, while stops hold: {held}")
        lost = [id for id in self.truth.standing() if not covers(held, id)]
        self.truth.wrong += [f"lost: stop {id}" for id in lost]
        over = [id for id, said in self.truth.stops.items() if said.released_s is not None]
        self.truth.wrong += [f"back: stop {id}" for id in held if id in over]
        while held := self._robot.held():
            await self._release(self.chance.choice(self._ops), held)
            await asyncio.sleep(0.02)
        for operator in self._ops:
            while why := await wait("a goal", self._send(operator)):
                self.truth.counts["tries"] += 1
                await asyncio.sleep(0.05)
                assert self.truth.counts["tries"] < 1000 * (1 + self.truth.counts["rounds"]), why
        await self._agree()
        self.truth.wrong += [f"back: stop {id}" for id in self._robot.held()]
        for id, goal in self.truth.goals.items():
            if goal.answer and self.truth.done[id] and not any(words in goal.answer for words in OPEN):
                self.truth.wrong.append(f"refused, but executed: goal {id}: {goal.answer}")
        self.truth.goals.clear()
        self.truth.stops.clear()
        self.truth.released.clear()

    def _is_here(self) -> bool:
        return self._robot.is_here(max(watch.status_s for watch in self.watches))

    async def _agree(self) -> None:
        try:
            await until("all agree", lambda: all(watch.agrees(self._robot.held()) for watch in self.watches))
        except TimeoutError:
            said = [(watch.relay, watch.robot, watch.status) for watch in self.watches]
            raise AssertionError(f"the robot has {self._robot.held()}, others say {said}") from None
