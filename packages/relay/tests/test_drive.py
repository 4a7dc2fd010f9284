"""Teleoperation: a robot moves while messages come in time, and stops where they do not; who drove is in the log."""

import asyncio
import json
import struct
from typing import Any

import pytest
from loop_cases import beside
from refusal_cases import refuse
from relay_cases import client, relay, settings, until, wait

from bufgym_relay.config import Rule
from bufgym_relay.drivers import TWIST, Drivers, check_speed
from bufgym_relay.rules import Identity, Permissions
from bufgym_robot.fleet.drive import Drive
from bufgym_robot.fleet.robot import Robot
from bufgym_robot.wire.driving import STILL, Velocity
from bufgym_robot.wire.messages import Message, RefusedError


def said(stamp_s: float, linear: Any = 0.5, angular: Any = 0.0, for_ms: Any = 400, sender: str = "ann") -> Message:
    payload = json.dumps({"linear": linear, "angular": angular, "for_ms": for_ms}).encode()
    return Message("/robots/r/drive", payload, sender=sender, stamp_us=round(stamp_s * 1e6))


class Clock:
    """A clock that stands until it is set."""

    def __init__(self) -> None:
        self.s = 100.0

    def __call__(self) -> float:
        return self.s


async def nowhere(velocity: Velocity) -> None:
    """Drive nobody."""


def test_a_velocity_ends_at_its_deadline() -> None:
    """The sender's clock is 93 s behind. A message that came .3 s later than the first has .1 s of its .4 s left."""
    clock = Clock()
    drive = Drive(nowhere, clock)
    assert drive.velocity == STILL and drive.driver == ""
    drive.take(said(7.0, 0.5, -0.25))
    clock.s = 100.39
    assert drive.velocity == (0.5, -0.25) and drive.driver == "ann"
    clock.s = 100.41
    assert drive.velocity == STILL and drive.driver == ""
    clock.s = 108.3
    drive.take(said(15.0))
    clock.s = 108.38
    assert drive.velocity == (0.5, 0.0)
    clock.s = 108.42  # clocks may have drifted apart by a thousandth of the 8 s
    assert drive.velocity == STILL


def test_a_rule_bounds_the_speed() -> None:
    """3 m/s and rad/s unless it says otherwise, in JSON and in a Twist; what is no number is none of these."""
    twist = Message("/robots/r/to/cmd_vel", b"\0\1\0\0" + struct.pack("<6d", 0, 0, 0, 0, 0, -4.0), "cdr", TWIST)
    for message in (said(1.0, 3.0, -3.0), twist._replace(payload=bytes(4) + bytes(48)), said(1.0)._replace(topic="/a")):
        check_speed(message, 3.0)
    check_speed(twist, 4.0)
    rule = "must be at most 3 m/s and rad/s, the speed of the rule"
    for wrong, what in ((said(1.0, 100.0), "100"), (said(1.0, 0.0, -3.5), "-3.5"), (twist, "-4")):
        refuse(f"topic {wrong.topic}: {what}: {rule}", check_speed, wrong, 3.0, kind=RefusedError)
    with pytest.raises(RefusedError, match="nan"):
        check_speed(twist._replace(payload=bytes(4) + struct.pack("<6d", float("nan"), 0, 0, 0, 0, 0)), 3.0)
    rules = (Rule(email="ann", send=True, speed=0.5), Rule(email="ann", send=True))
    assert Permissions(rules, Identity(email="ann")).speed("/robots/r/drive") == 0.5


async def test_too_fast_a_velocity_is_refused_by_the_relay() -> None:
    async with relay(settings()) as server, client(server.port) as one, client(server.port) as robot:
        await robot.subscribe("^/robots/r/drive$")
        for linear in (1e308, 2.0):
            await one.put("/robots/r/drive", said(1.0, linear).payload, encoding="json")
        (refused,) = await one.rest()
        assert refused["code"] == "wrong" and "1e+308: must be at most 3 m/s" in refused["why"]
        assert [json.loads(bytes(message.payload))["linear"] for message in await robot.rest()] == [2.0]


def test_what_waited_on_a_link_moves_nothing() -> None:
    """A link stalls for 2 s. What was said meanwhile comes too late, in a burst; the first in time moves it again."""
    clock = Clock()
    drive = Drive(nowhere, clock)
    drive.take(said(7.0))
    clock.s = 102.0
    for stamp_s in (7.1, 7.2, 8.5):
        drive.take(said(stamp_s))
        assert drive.velocity == STILL
    drive.take(said(9.0))
    assert drive.velocity == (0.5, 0.0)
    drive.take(said(8.9, for_ms=1000, linear=9.0))  # behind a later one
    assert drive.velocity == (0.5, 0.0)
    drive.take(said(9.01, linear=0.0, for_ms=0))  # released
    assert drive.velocity == STILL


def test_one_drives_at_a_time() -> None:
    clock = Clock()
    drive = Drive(nowhere, clock)
    drive.take(said(7.0))
    drive.take(said(50.0, -1.0, sender="bob"))
    assert (drive.driver, drive.velocity) == ("ann", (0.5, 0.0))
    clock.s = 100.5
    drive.take(said(50.5, -1.0, sender="bob"))
    assert (drive.driver, drive.velocity) == ("bob", (-1.0, 0.0))


@pytest.mark.parametrize(
    "wrong", [{"linear": "fast"}, {"angular": None}, {"for_ms": 1001}, {"for_ms": -1}, {"linear": 1e999}]
)
def test_what_drives_nothing(wrong: dict[str, Any]) -> None:
    drive = Drive(nowhere, Clock())
    refuse("topic /robots/r/drive: .* must be JSON with the finite numbers", drive.take, said(1.0, **wrong))
    refuse("must be JSON", drive.take, Message("/robots/r/drive", b"["))
    assert drive.velocity == STILL


def test_who_drove_is_in_the_audit_log() -> None:
    """A begin and an end, not each message; the end is a second after the last."""
    clock, entries = Clock(), list[dict[str, Any]]()
    drivers = Drivers(lambda event, **fields: entries.append({"event": event, **fields}), clock)
    who = {"topic": "/robots/r/drive", "session": "s", "email": "ann@example.org"}
    for _ in range(31):
        drivers.note(who["topic"], "s", email=who["email"])
        drivers.note("/robots/r/status", "s", email=who["email"])
        drivers.tick()
        clock.s += 0.1
    assert entries == [{"event": "drives", **who}]
    clock.s += 1.0
    drivers.tick()
    drivers.tick(0.0)
    assert entries[1:] == [{"event": "drove", **who, "seconds": 3.0}]


class Car:
    """A source that notes its velocities."""

    streams = ()

    def __init__(self) -> None:
        self.moves: list[tuple[float, float]] = []

    async def run(self, robot: Robot) -> None:
        await asyncio.Event().wait()

    def status(self) -> dict[str, Any]:
        return {"commands": ["drive"]}

    async def on_command(self, command: Any) -> None:
        assert command["command"] == "drive"
        self.moves.append((command["linear"], command["angular"]))


async def test_a_robot_whose_link_is_cut_stops() -> None:
    """The relay goes away while somebody drives: the last velocity is followed by zeros."""
    car = Car()
    async with relay(settings()) as server:
        robot = Robot(f"ws://127.0.0.1:{server.port}", "r", car, policy="drop-oldest")
        async with beside(robot.run()):
            async with client(server.port, name="ann") as ann:
                await wait("the robot", robot.client.ready.wait())
                message = said(1.0, 0.5, 0.25, for_ms=1000)
                while not car.moves:  # until the robot has subscribed
                    await ann.put(message.topic, bytes(message.payload), encoding="json")
                    await ann.rest()
                await server.close()
            await until("it stands", lambda: car.moves[-1] == STILL)
    assert set(car.moves[:-1]) == {(0.5, 0.25)}


async def test_a_robot_that_ends_stops() -> None:
    moves, moving = list[Velocity](), asyncio.Event()

    async def move(velocity: Velocity) -> None:
        moves.append(velocity)
        moving.set()

    drive = Drive(move, Clock())
    async with beside(drive.run()):
        drive.take(said(7.0))
        await wait("it moves", moving.wait())
    assert moves == [(0.5, 0.0), STILL]


async def test_only_a_rule_lets_drive() -> None:
    """The relay refuses who may not send there, and logs who may."""
    rules = (Rule(address="127.0.0.0/8", send=True, receive=True, topic="/robots/a/.*"),)
    async with relay(settings(rules=rules)) as server, client(server.port, name="ann") as ann:
        for robot in "ab":
            await ann.put(f"/robots/{robot}/drive", said(1.0).payload, encoding="json")
        (refused,) = await ann.rest()
        assert (refused["code"], refused["topic"]) == ("unauthorized", "/robots/b/drive")
        log = server.hub.audit.recent
    assert [(one["event"], one["topic"]) for one in log if one["event"] in ("drives", "drove")] == [
        ("drives", "/robots/a/drive"),
        ("drove", "/robots/a/drive"),
    ]
