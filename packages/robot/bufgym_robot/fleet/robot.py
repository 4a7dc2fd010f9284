"""A robot at a relay: it publishes its source's messages and its queue's state, and takes commands.

A robot's topics lie under ``/robots/NAME/``. Besides its source's topics it publishes ``queue`` five times a second and
``status`` once a second, with battery, location, network, queue and the list of topics. The command ``{"command":
"policy", "policy": "afr"}`` on its topic ``command`` changes its queue's policy. Its status answers the latest command
by the command's ``id``, with the reason ``why`` if it was refused. Messages on its topic ``drive`` move it as
``bufgym_robot.fleet.drive`` says. A command later than its deadline is refused. A stop on its topic ``stop`` holds as
``bufgym_robot.fleet.latch`` says.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import time
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from operator import methodcaller
from typing import Any, Final, Protocol

import msgspec

from bufgym.model.qoi import Value
from bufgym.model.topics import Topic
from bufgym.policies.registry import Policy, get
from bufgym.scenario import Stream
from bufgym.utils.errors import BufgymError
from bufgym_robot.fleet.client import RobotClient
from bufgym_robot.fleet.drive import Drive
from bufgym_robot.fleet.kept import Kept, place
from bufgym_robot.fleet.latch import Latch
from bufgym_robot.fleet.monitor import Monitor
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.driving import TOPIC, Velocity
from bufgym_robot.wire.ledger import Stop
from bufgym_robot.wire.orders import STOP, heard_stops
from bufgym_robot.wire.patterns import exactly
from bufgym_robot.wire.place import Place
from bufgym_robot.wire.tasks import Tasks, until_one_ends

STATUS_S: Final = 1.0
QUEUE_S: Final = 0.2
MOST_BEGUN: Final = 256  # Commands that are remembered, longer than any of them is worth
POLICIES: Final = ("robofleet", "afr", "min-motion-gap", "drop-oldest", "drop-newest", "fifo", "gap-priority")
"""Policies that a viewer may choose by default."""
_RATES_HZ: Final = {"status": 1 / STATUS_S, "queue": 1 / QUEUE_S}
_OWN: Final = tuple(Stream(Topic(name, priority=20.0, weight=0.0), hz, 1000) for name, hz in _RATES_HZ.items())


class Source(Protocol):
    """Source of a robot's messages: the made-up robot, a recording, ROS, or any program."""

    @property
    def streams(self) -> Sequence[Stream]:
        """Its topics, with the rules for each."""

    async def run(self, robot: Robot) -> None:
        """Publish with ``robot.publish`` until there is no more."""

    def status(self) -> dict[str, Any]:
        """Return ``battery``, ``location``, ``ok``, ``text`` and the like, as far as they are known."""

    async def on_command(self, command: Any) -> None:
        """Take a command that is not the robot's own, or raise a BufgymError that says why not.

        After ``{"command": "stop"}`` the robot hands on nothing that moves it, until it is released. A command at which
        this is at work when a stop comes is cancelled.

        A source that takes ``{"command": "drive", "linear": m/s, "angular": rad/s}`` lists ``drive`` in ``commands`` of
        its status. Zeros follow as soon as the person who drives is silent for too long.
        """


class Robot:
    """One robot's connection. See the module's text."""

    def __init__(
        self,
        url: str,
        name: str,
        source: Source,
        *,
        policy: str | Policy = "robofleet",
        value: Value | None = None,
        policies: Sequence[str] = POLICIES,
        odometry: str | None = None,
        **session: Any,
    ) -> None:
        """Arguments as for ``RobotClient``; a command may choose one of ``policies``.

        ``odometry`` names the source's topic that says where the robot is and gives x, as
        ``bufgym_robot.wire.place`` says.
        """
        wire.check_robot(name)
        self.name, self.source = name, source
        streams = [*source.streams]
        streams += [own for own in _OWN if own.topic.name not in {stream.topic.name for stream in streams}]
        self._streams = {stream.topic.name: stream for stream in streams}
        topics = [replace(stream.topic, name=self.topic(stream.topic.name)) for stream in streams]
        self.monitor = Monitor([stream.topic for stream in streams], value)
        self._policies = tuple(dict.fromkeys([get(policy).name, *policies]))
        self._kinds: dict[str, dict[str, str]] = {}
        self._answer: dict[str, Any] = {}
        self.place = Place(odometry)
        self._began_s = time.monotonic()
        settings = {"topics": topics, "policy": policy, "value": value, "log": self.monitor, **session}
        self.client = RobotClient(url, name, robot=name, **settings)
        self._kept = Kept(place(self.client.address.netloc, name))
        self.latch = Latch(self._kept.load())
        self._said: list[dict[str, Any]] = self.latch.ledger.as_json()
        self._saving = asyncio.Lock()
        self._drive = Drive(self._move)
        if self.latch.is_set:
            self._drive.stop()
        self._tasks = Tasks()
        self._begun: dict[int, asyncio.Task[str]] = {}
        """Number of a command -> its work, so that one that comes again, after a break, is not begun twice."""
        # The stops first: they are there before a command that waited.
        self.client.subscribe(exactly(self.topic(STOP)), self._ordered)
        self.client.subscribe(exactly(self.topic("command")), self._command)
        self.client.subscribe(exactly(self.topic(TOPIC)), self._driven)
        self.client.late, self.client.reads_on, self.client.begun = self._late, True, self._begun

    def topic(self, name: str) -> str:
        """Put the robot's prefix before a topic's name."""
        return f"/robots/{self.name}/{name.lstrip('/')}"

    def publish(self, topic: str, payload: bytes, encoding: str, type: str = "", stamp_us: int | None = None) -> None:
        """Put a message of the source's topic into the queue, from any thread."""
        stream = self._streams[topic]
        self._kinds[topic] = {"type": type, "encoding": encoding}
        self.place.take(topic, payload, type, encoding)
        x = self.place.x if stream.moves else (time.monotonic() - self._began_s) * stream.unit_hz
        try:
            self.client.publish(self.topic(topic), payload, encoding, type, x, stamp_us)
        except wire.RefusedError as refused:  # too large: no reason for a robot to stop
            self.client.note(str(refused))

    def say(self, topic: str, data: Any) -> None:
        """Publish ``data`` as JSON; NaN, as of a battery that is not measured, becomes null."""
        try:
            payload = msgspec.json.encode(data, enc_hook=methodcaller("item"))  # of NumPy's numbers
        except Exception as error:  # also an item's own; no reason for a robot to stop
            self.client.note(f"topic {topic}: must be JSON: {error}")
        else:
            self.publish(topic, payload, "json")

    def status(self) -> dict[str, Any]:
        """Return the robot's state."""
        queue = self.monitor.state()
        round_trip_s, own = self.client.round_trip_s, self.source.status()
        return {
            "battery": None,
            "location": self.place.location,
            "network": {
                "rate_bps": queue["rate_bps"],
                "rtt_ms": None if round_trip_s is None else round(1000 * round_trip_s, 1),
            },
            "queue": queue,
            "publishes": self._kinds,
            "policies": self._policies,
            "answer": self._answer,
            "driver": self._drive.driver,
            "stop": self.latch.status,
            "stops": self._said,
            **({"unwritten": True} if self._kept.is_behind else {}),
            **own,
            "commands": sorted({*own.get("commands", ()), "stop", "release"}),
        }

    async def run(self) -> None:
        """Run until the source has no more, or until cancelled."""

        async def status() -> None:
            if self._kept.is_behind:
                await self._write()
            self.say("status", self.status())

        async def queue() -> None:
            self.say("queue", self.monitor.state())

        if self._kept.fault:
            self.client.note(self._kept.fault)
        own = [(STATUS_S, status), (STATUS_S, self.client.ping), (QUEUE_S, queue)]
        every = [self._every(period_s, work) for period_s, work in own]
        try:
            await until_one_ends(self._drive.run(), self.source.run(self), self.client.run(), *every)
        finally:
            for work in self._begun.values():
                work.cancel()
            await self._tasks.end()

    async def _every(self, period_s: float, work: Callable[[], Awaitable[None]]) -> None:
        await self.client.connected.wait()
        loop = asyncio.get_running_loop()
        next_s = loop.time()
        while True:
            await work()
            next_s = max(next_s + period_s, loop.time())
            await asyncio.sleep(next_s - loop.time())

    def _driven(self, message: wire.Message) -> None:
        try:
            self._drive.take(message)
        except BufgymError as error:
            self.client.note(str(error))

    async def _move(self, velocity: Velocity) -> None:
        try:
            await self.source.on_command({"command": "drive", **velocity._asdict()})
        except BufgymError as error:
            self.client.note(str(error))

    def refusal(self, message: wire.Message) -> str:
        """Say why a command must not be executed now, or nothing. Sources ask this of what goes past ``on_command``."""
        return "its deadline is over" if self.client.deadlines.is_late(message) else self.latch.refusal(message)

    def _late(self, message: wire.Message) -> None:
        if message.topic != self.topic(TOPIC):
            self._answered(message, "came too late")

    async def _command(self, message: wire.Message) -> str:
        try:
            command = json.loads(bytes(message.payload))
        except ValueError:
            return "it is no JSON"  # a sender's mistake is no reason for a robot to stop
        why = await self.once(message, partial(self._execute, message, command))
        self._answered(message, why)
        return why

    async def once(self, message: wire.Message, work: Callable[[], Coroutine[Any, Any, str]]) -> str:
        """Begin the work on a command unless it was begun before, and wait for why it was not done, if so.

        The work goes on while a broken connection is made anew; then the command comes again.
        """
        task = self._begun.get(message.number) if message.number else None
        if task is None:
            task = asyncio.create_task(work())
            self._begun[message.number or -id(task)] = task
            while len(self._begun) > MOST_BEGUN and next(iter(self._begun.values())).done():
                del self._begun[next(iter(self._begun))]
        return await asyncio.shield(task)

    async def _execute(self, message: wire.Message, command: Any) -> str:
        """Execute a command; return why not."""
        kind, why = command.get("command") if isinstance(command, dict) else None, self.refusal(message)
        try:
            if why:
                return why
            if kind == STOP:
                self._stop([Stop(f"command-{secrets.token_hex(8)}", 1, message.sender, message.at_us)])
                return ""
            if kind == "policy":
                if command.get("policy") not in self._policies:
                    raise BufgymError(f"policy {command.get('policy')!r}: must be one of {', '.join(self._policies)}")
                await asyncio.to_thread(self.client.change, command["policy"])
                return ""
            return await self.latch.unless_stopped(self._tasks.begin(self._done(command)))
        except BufgymError as error:
            return str(error)

    async def _done(self, command: Any) -> None:
        await self.source.on_command(command)

    def _answered(self, message: wire.Message, why: str) -> None:
        """Have the status say how a command went."""
        with suppress(ValueError):
            command = json.loads(bytes(message.payload))
            self._say_answer(str(command.get("id")) if isinstance(command, dict) else "", why)

    def _say_answer(self, id: str, why: str) -> None:
        self._answer = {"id": id[:150], "why": why[:300]}
        self.say("status", self.status())

    def _ordered(self, message: wire.Message) -> None:
        """Take the ledger that the relay says."""
        self._stop(heard_stops(message))

    def _stop(self, stops: Sequence[Stop]) -> None:
        """Take stops and releases: stand at once, waiting for nothing that is under way."""
        new = self.latch.take(stops)
        if not new:
            return
        if any(stop.holds for stop in new):
            self._drive.stop()
        elif not self.latch.is_set:
            self._drive.go()
        self._tasks.begin(self._stopped(new))

    async def _stopped(self, new: Sequence[Stop]) -> None:
        """Tell the program of a stop, write all down, and then confirm it."""
        why = ""
        if any(stop.holds for stop in new):
            try:
                await self.source.on_command({"command": STOP})
            except Exception as error:  # whatever it is, the stop is written down
                why = str(error) if isinstance(error, BufgymError) else f"{type(error).__name__}: {error}"
        await self._write()
        self._say_answer(new[-1].id, why)

    async def _write(self) -> None:
        async with self._saving:
            said = self.latch.ledger.as_json()
            await asyncio.to_thread(self._kept.save, said)
            self._said = said
        if self._kept.fault:
            self.client.note(self._kept.fault)
