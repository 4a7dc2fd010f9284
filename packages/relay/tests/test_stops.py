"""Commands on links that break: none is executed after its deadline, and a stop comes first, alone, and holds."""

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest
from cut_cases import Cuttable, cuttable
from loop_cases import beside, compiled
from relay_cases import client, relay, settings, until, wait

from bufgym.utils.errors import BufgymError
from bufgym_relay.config import Rule
from bufgym_relay.orders import Orders
from bufgym_robot.fleet.drive import Drive
from bufgym_robot.fleet.robot import Robot
from bufgym_robot.fleet.ros import Ros1
from bufgym_robot.wire import backoff
from bufgym_robot.wire.clock import RelayClock
from bufgym_robot.wire.driving import STILL, Velocity
from bufgym_robot.wire.ledger import Stop
from bufgym_robot.wire.messages import Message, RefusedError
from bufgym_robot.wire.orders import moves
from bufgym_robot.wire.session import Session

COMMAND, STOP = "/robots/r/command", "/robots/r/stop"


def test_a_client_knows_bounds_of_the_relays_clock() -> None:
    """Asked at 10 s, answered at 12 s with 1,000 s: between 998 (the answer took all of it) and 1,000 s at 12 s.

    100 s later clocks may have drifted apart by .05 s.
    """
    now_s = 12.0
    clock = RelayClock(lambda: now_s)
    assert not clock.known
    clock.heard(1_000_000_000, asked_s=10.0)
    assert clock.earliest_us(12.0) == 1_000_000_000
    assert not clock.is_past(1_002_000_001) and clock.is_past(1_001_999_999)
    now_s = 112.0
    assert clock.earliest_us(112.0) == 1_099_950_000
    assert not clock.is_past(1_102_060_000) and clock.is_past(1_102_040_000)
    clock.heard(1_100_500_000)  # a message that was quicker than the answer: the clock is at least that far
    assert clock.earliest_us(112.0) == 1_100_500_000


def said(what: dict[str, Any], at_us: int, until_us: int = 0, topic: str = COMMAND) -> Message:
    return Message(topic, json.dumps(what).encode(), at_us=at_us, until_us=until_us)


def test_deadlines_by_hand() -> None:
    """3 s from when the relay took it, or what its sender says, if that is less."""
    orders = Orders()
    goal = {"command": "goal", "id": "1"}
    assert orders.dated(said(goal, 1_000_000), 3.0, 1_000_000).until_us == 4_000_000
    assert orders.dated(said(goal, 1_000_000, 2_500_000), 3.0, 1_000_000).until_us == 2_500_000
    assert orders.dated(said(goal, 1_000_000, 9_000_000), 3.0, 1_000_000).until_us == 4_000_000
    with pytest.raises(RefusedError, match=r"0\.5 s after its deadline"):
        orders.dated(said(goal, 1_000_000, 500_000), 3.0, 1_000_000)
    with pytest.raises(RefusedError, match="waited longer than the 3 s"):  # for the disk
        orders.dated(said(goal, 1_000_000), 3.0, 4_000_001)
    late = said(goal, 1_000_000, 4_000_000)
    assert not orders.is_over(late, 4_000_000) and orders.is_over(late, 4_000_001)
    other = said({}, 1_000_000, topic="/robots/r/camera")
    assert orders.dated(other, 3.0, 9_000_000) == other and not orders.is_over(other, 9_000_000)


def test_a_stop_withdraws_what_the_relay_took_before_it() -> None:
    orders = Orders()
    goal, stop = {"command": "goal", "id": "1"}, {"command": "stop", "id": "bob-1"}
    before = orders.dated(said(goal, 1_000_000), 3.0, 1_000_000)
    new = orders.ordered(said(stop, 2_000_000, topic=STOP), "bob@x.org", "<bob@x.org>")
    assert new == orders.ledgers["r"].held == [Stop("bob", 1, "bob@x.org", 2_000_000)]
    assert orders.ordered(said(stop, 2_050_000, topic=STOP), "bob@x.org", "<bob@x.org>") == []
    assert orders.is_over(before, 2_000_000)
    assert not orders.is_over(before._replace(topic="/robots/other/command"), 2_000_000)
    with pytest.raises(RefusedError, match=r"r was stopped by bob@x\.org: release it first"):
        orders.dated(said(goal, 2_100_000), 3.0, 2_100_000)
    cancel = said({"command": "cancel"}, 2_100_000)
    assert orders.dated(cancel, 3.0, 2_100_000).until_us == 5_100_000
    with pytest.raises(RefusedError, match=r"stopped again, by bob@x\.org"):
        orders.ordered(said({"command": "release", "id": "x", "of": "bob-0"}, 2_200_000, topic=STOP), "ann", "ann")
    orders.ordered(said({"command": "release", "id": "x", "of": "bob-1"}, 2_300_000, topic=STOP), "ann", "ann")
    assert orders.ledgers["r"].held == []
    after = orders.dated(said(goal, 2_400_000), 3.0, 2_400_000)
    assert (after.seen, orders.is_over(after, 2_400_000), orders.is_over(before, 2_400_000)) == (
        '{"bob":1}',
        False,
        True,
    )
    with pytest.raises(RefusedError, match=r"topic /robots/r/stop: b'\{.*must be"):
        orders.ordered(said({"command": "goal", "id": "x"}, 1, topic=STOP), "ann", "ann")


def test_what_moves_a_robot() -> None:
    twist = Message("/robots/r/to/cmd_vel", b"\0\1\0\0" + bytes(48), "cdr", "geometry_msgs/msg/Twist")
    assert not moves(twist) and moves(twist._replace(payload=b"\0\1\0\0" + bytes(47) + b"\1"))
    assert moves(twist._replace(type="geometry_msgs/msg/PoseStamped"))
    assert moves(said({"command": "goal"}, 1)) and moves(Message(COMMAND, b"["))
    assert not moves(said({"command": "policy"}, 1))


def test_a_held_key_moves_nothing_until_it_was_let_go_and_the_robot_released() -> None:
    async def nowhere(velocity: Velocity) -> None:
        """Drive nobody."""

    drive, stamps = Drive(nowhere, lambda: 100.0), iter(range(1, 100))

    def press(linear: float, sender: str = "ann") -> Velocity:
        payload = json.dumps({"linear": linear, "angular": 0.0, "for_ms": 400}).encode()
        drive.take(Message("/robots/r/drive", payload, sender=sender, stamp_us=next(stamps)))
        return drive.velocity

    assert press(0.5) == (0.5, 0.0)
    drive.stop()
    assert drive.velocity == STILL and press(0.5) == STILL
    press(0.0)
    assert press(0.5) == STILL  # let go, and pressed again while the stop holds
    drive.go()
    assert press(0.5) == STILL and press(0.5, "bob") == STILL
    press(0.0)
    assert press(0.5) == (0.5, 0.0)


class Program:
    """A robot's program: what it executed, and when by the test's clock; a goal may keep it at work."""

    streams = ()

    def __init__(self) -> None:
        self.done: list[tuple[str, float]] = []
        self.at_work = False
        self.works = asyncio.Event()
        self.works.set()

    async def run(self, robot: Robot) -> None:
        await asyncio.Event().wait()

    def status(self) -> dict[str, Any]:
        return {"commands": ["stop", "goal", "drive"]}

    async def on_command(self, command: Any) -> None:
        if command["command"] == "goal":
            self.at_work = True
            await self.works.wait()
        self.done.append((command.get("id", command["command"]), time.monotonic()))

    @property
    def names(self) -> list[str]:
        return [name for name, _ in self.done]


RULE = Rule(address="127.0.0.0/8", send=True, receive=True, command_s=0.5)


class Scene:
    """A relay, a robot behind one link and an operator behind another."""

    def __init__(self, program: Program, robot: Robot, operator: Session, links: tuple[Cuttable, Cuttable]) -> None:
        self.program, self.robot, self.operator = program, robot, operator
        self.near, self.far = links
        """Links of the operator and of the robot."""

    async def goal(self, id: str) -> str:
        """Send a goal; return why it was refused."""
        try:
            await self.operator.command(COMMAND, {"command": "goal", "id": id})
        except BufgymError as error:
            return str(error)
        return ""


@contextlib.asynccontextmanager
async def scene(rule: Rule = RULE) -> AsyncIterator[Scene]:
    async with relay(settings(rules=(rule,))) as server, cuttable(server.port) as near, cuttable(server.port) as far:
        program = Program()
        robot = Robot(f"ws://127.0.0.1:{far.port}", "r", program, policy="drop-oldest")
        operator = Session(f"ws://127.0.0.1:{near.port}", "operator")
        async with beside(robot.run(), operator.run()):
            await wait("the robot", robot.client.ready.wait())
            await wait("the operator", operator.ready.wait())
            yield Scene(program, robot, operator, (near, far))


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backoff, "MOST_S", 0.05)


@compiled
async def test_a_goal_that_waited_on_a_link_is_refused_and_the_stop_comes_first() -> None:
    """Either link freezes for longer than the .5 s of a goal. The goal is never executed; the stop is, once."""
    for which in ("near", "far"):
        async with scene() as one:
            assert await one.goal("first") == ""
            await until("the first goal", lambda: one.program.names == ["first"])
            link = getattr(one, which)
            link.freeze()
            goal = asyncio.ensure_future(one.goal("late"))
            stop = asyncio.ensure_future(one.operator.stop("r"))
            await asyncio.sleep(0.7)
            link.thaw()
            id = await wait("the stop", stop)
            await wait("the goal", goal)
            await until("it stands", lambda id=id: one.robot.latch.status == {"id": id, "by": "operator"})
            await until("the program", lambda: one.program.names[1:2] == ["stop"])
            assert "was stopped by operator" in await one.goal("while it holds")
            await one.operator.release("r", id)
            await until("it is free", lambda: one.robot.latch.status is None)
            assert await one.goal("next") == ""
            await until("the next goal", lambda: one.program.names[-1] == "next")
            assert one.program.names == ["first", "stop", "next"]


async def test_a_goal_whose_deadline_passes_while_it_is_read_is_not_published() -> None:
    """The first message of a type is read for a second: a source of ROS asks for its deadline after that."""
    robot, source = Robot("ws://127.0.0.1:1", "r", Ros1([], ["goal_pose"])), Ros1([], ["goal_pose"])
    relay_s, published, said = [0.0], list[bytes](), list[str]()
    robot.client.deadlines.clock = RelayClock(lambda: relay_s[0])
    robot.client.deadlines.clock.heard(100_000_000, 0.0)
    robot.client.note = said.append  # type: ignore[method-assign]
    takes = dict[str, Any]()
    robot.client.subscribe = lambda pattern, take: takes.update({pattern: take})  # type: ignore[method-assign]

    async def advertise(topic: Any) -> Any:
        def read(payload: bytes) -> Any:
            relay_s[0] += 1.0
            return lambda: published.append(payload)

        return read

    source._listen(robot, advertise)
    for payload, until_us in ((b"in time", 101_500_000), (b"too late", 101_500_000), (b"in time", 103_500_000)):
        goal = Message("/robots/r/to/goal_pose", payload, "cdr", "geometry_msgs/msg/PoseStamped", until_us=until_us)
        await takes["^/robots/r/to/"](goal)
    assert published == [b"in time", b"in time"]
    assert said == ["/robots/r/to/goal_pose: not published: its deadline is over"]


@compiled
async def test_a_stop_does_not_wait_for_a_program_at_work() -> None:
    """Another operator's goals are withdrawn, the one at work and the one behind it; both are told why."""
    async with scene() as one:
        one.program.works.clear()
        other = Session(f"ws://127.0.0.1:{one.near.port}", "other")
        async with beside(other.run()):
            says = [{"command": "goal", "id": id} for id in ("long", "behind it")]
            goals = [asyncio.ensure_future(other.command(COMMAND, goal)) for goal in says]
            await until("it works", lambda: one.program.at_work)
            await wait("the stop", one.operator.stop("r"))
            await until("it stands", lambda: one.program.names == ["stop"])
            one.program.works.set()
            for goal in goals:
                with pytest.raises(BufgymError, match=r"stopped by operator|withdrawn by a stop"):
                    await wait("the receipt", goal)
        assert one.program.names == ["stop"]


@compiled
async def test_a_robot_that_was_away_hears_the_stop_before_all_else() -> None:
    """The stop waits at the relay for a robot whose link is cut. A release of an earlier stop changes nothing."""
    async with scene(RULE) as one:
        one.far.cut()
        await until("the relay knows", lambda: not one.robot.client.connected.is_set())
        first = await wait("a stop", one.operator.stop("r"))
        second = await wait("another", one.operator.stop("r"))
        with pytest.raises(BufgymError, match="stopped again, by operator"):
            await one.operator.release("r", first)
        one.far.mend()
        await until("it stands", lambda: one.robot.latch.status == {"id": second, "by": "operator"})
        await until("the program", lambda: one.program.names == ["stop"])


@compiled
async def test_wrong_clocks_of_clients_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A goal stamped an hour ago or ahead is executed; one that the relay could not be told in time is not."""
    async with scene() as one, client(one.near._target, name="odd") as odd:
        for number, stamp_s in enumerate((time.time() - 3600, time.time() + 3600), 1):
            goal = json.dumps({"command": "goal", "id": f"g{number}"}).encode()
            about = {"encoding": "json", "seq": number, "no_drop": True, "stamp_us": round(stamp_s * 1e6)}
            await odd.put(COMMAND, goal, **about)
            while (said := await odd.next()) != {"op": "ack", "seq": number}:
                assert said["op"] == "delivered"  # what became of the one before
        await until("both", lambda: one.program.names == ["g1", "g2"])
        past_us = odd.welcome["clock_us"] - 1
        await odd.put(COMMAND, b'{"command": "goal"}', encoding="json", seq=3, no_drop=True, until_us=past_us)
        refused = next(one for one in await odd.rest() if one["op"] == "refused")
        assert (refused["code"], refused["seq"]) == ("too_late", 3)
