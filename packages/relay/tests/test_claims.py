"""Who is which robot: each hears its own goals and stops and nobody else's, and two of one name are told apart."""

import asyncio
import json
import random
from pathlib import Path
from typing import Any

import pytest
from loop_cases import beside, compiled
from relay_cases import Client, client, nothing, relay, settings, until, wait
from test_stops import Program

from bufgym.utils.errors import BufgymError
from bufgym_relay import claims
from bufgym_relay.config import Limits, Rule
from bufgym_robot.fleet.robot import Robot
from bufgym_robot.wire import backoff
from bufgym_robot.wire.messages import RefusedError, WireError
from bufgym_robot.wire.patterns import exactly, pattern, topic_of
from bufgym_robot.wire.session import Session

pytestmark = compiled
ASCII = [chr(code) for code in range(0x20, 0x7F) if chr(code) != "/"]
CHANCE = random.Random(0)


def unicode_name() -> str:
    while True:
        name = "".join(chr(CHANCE.randrange(0x20, 0x3000)) for _ in range(CHANCE.randrange(1, 12)))
        if name.isprintable() and "/" not in name:
            return name


ODD = ["amr.1", "amr-1", "amrx1", "a|b", "amr(2)", "amr[3]", "c+", "c++", "amr$4"]
NAMES = list(dict.fromkeys([*(f"amr{letter}1" for letter in ASCII), *ODD, *(unicode_name() for _ in range(200))]))


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backoff, "MOST_S", 0.05)


def test_an_exact_expression_matches_its_topic_alone() -> None:
    topics = [f"/robots/{name}/command" for name in NAMES]
    for topic in topics:
        assert topic_of(exactly(topic)) == topic
        assert [one for one in topics if pattern(exactly(topic)).part(one)] == [topic]
    assert topic_of("^/a.b$") is None and topic_of("/a") is None


async def test_each_name_is_told_apart_from_all_others() -> None:
    """Robots of 300 names at one relay: each gets one goal and one stop, by its own name."""
    rule = Rule(address="127.0.0.0/8", send=True, receive=True, command_s=60)
    async with relay(settings(rules=(rule,), limits=Limits(topics=10_000))) as server:
        url, programs = f"ws://127.0.0.1:{server.port}", {name: Program() for name in NAMES}
        for some in (NAMES[k : k + 100] for k in range(0, len(NAMES), 100)):
            robots = [Robot(url, name, programs[name], policy="drop-oldest", capacity=2) for name in some]
            operator = Session(url, "operator")
            async with beside(operator.run(), *(robot.run() for robot in robots)):
                for one in (operator, *(robot.client for robot in robots)):
                    await wait("all are here", one.ready.wait())
                for name in some:
                    await wait(name, operator.command(f"/robots/{name}/command", {"command": "goal", "id": name}))
                for name in some:
                    await wait(name, operator.stop(name))
                await until("all stand", lambda robots=robots: all(robot.latch.is_set for robot in robots))
                await until("all know", lambda some=some: all(len(programs[name].names) == 2 for name in some))
        assert {name: program.names for name, program in programs.items()} == {name: [name, "stop"] for name in NAMES}


@pytest.mark.parametrize("name", ["", "a/b", "a\nb", "\x1b[31m", "é" * 120])
def test_a_name_that_topics_cannot_have_is_refused_at_the_start(name: str) -> None:
    with pytest.raises(WireError, match="robot '"):
        Robot("ws://127.0.0.1:1", name, Program())


async def test_a_second_robot_of_a_name_is_refused_while_the_first_is_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """It gets in once the first has gone, or is silent. All who watch are told, and one of both executes a goal."""
    async with relay(settings()) as server, client(server.port, name="watch") as watch:
        await watch.subscribe("^/robots/twin/claim$")
        url, programs = f"ws://127.0.0.1:{server.port}", [Program(), Program()]
        robots = [Robot(url, "twin", program, policy="drop-oldest") for program in programs]
        operator = Session(url, "operator")
        async with beside(operator.run()), beside(robots[0].run()) as first:
            await wait("the first", robots[0].client.ready.wait())
            async with beside(robots[1].run()):
                await until("its refusal", lambda: any("another robot" in why for why in robots[1].client.faults))
                said = json.loads(bytes((await watch.next()).payload))
                assert said["why"] == "two robots have this name: the one at 127.0.0.1 was refused"
                await wait("a goal", operator.command("/robots/twin/command", {"command": "goal", "id": "g"}))
                assert [program.names for program in programs] == [["g"], []]
                first[0].cancel()
                await wait("the second", robots[1].client.ready.wait())
                await wait("a goal", operator.command("/robots/twin/command", {"command": "goal", "id": "h"}))
                assert [program.names for program in programs] == [["g"], ["h"]]
                # Its connection goes silent: whoever comes next takes over.
                monkeypatch.setattr(claims, "SILENT_S", -1.0)
                async with beside(Robot(url, "twin", Program(), policy="drop-oldest").run()):
                    while "took over" not in json.loads(bytes((await watch.next()).payload))["why"]:
                        pass


async def test_who_may_not_be_a_robot_is_told_why() -> None:
    rules = (Rule(address="127.0.0.0/8", send=True, topic="/robots/a/.*"), Rule(address="127.0.0.0/8", receive=True))
    async with relay(settings(rules=rules)) as server:
        with pytest.raises(RefusedError, match="robot b: no rule allows to send /robots/b/status"):
            await wait("a refusal", Session(f"ws://127.0.0.1:{server.port}", "b", robot="b").run())
        async with client(server.port, robot="a") as one:
            assert "robot: needs a session of a name" in one.welcome["why"]


async def test_a_command_waits_for_its_robot_and_for_nobody_who_watches() -> None:
    """A robot is away for a moment: its command comes when it is back. One whose deadline passes is not reached."""
    rule = Rule(address="127.0.0.0/8", send=True, receive=True, command_s=1.0)
    async with relay(settings(rules=(rule,))) as server, client(server.port, name="watch") as watch:
        await watch.subscribe("^/robots/")
        operator = Session(f"ws://127.0.0.1:{server.port}", "operator")

        async def goal(id: int) -> str:
            try:
                await wait("a receipt", operator.command("/robots/r/command", {"command": "goal", "id": id}))
            except BufgymError as error:
                return str(error)
            return "executed"

        async with beside(operator.run()):
            assert "robot r is not here" in await goal(0)
            async with client(server.port, session="r", robot="r") as robot:
                first = asyncio.ensure_future(goal(1))
                await robot_does(robot, 1)
                assert await first == "executed"
            second = asyncio.ensure_future(goal(2))
            await asyncio.sleep(0.2)
            async with client(server.port, session="r", robot="r", received=1) as robot:
                await robot_does(robot, 2, "the way is blocked")
                assert "the way is blocked" in await second
                assert await nothing(robot)
            assert "not reached" in await goal(3)


async def robot_does(robot: Client, seq: int, why: str = "") -> None:
    while not (getattr(said := await robot.next(), "no_drop", False)):
        pass
    assert (said.seq, said.number > 0) == (seq, True)
    await robot.say("ack", seq=seq, **({"why": why} if why else {}))


class Slow(Program):
    """A program whose goals take as long as the test likes."""

    async def on_command(self, command: Any) -> None:
        self.done.append((f"begins {command.get('id')}", 0.0))
        await super().on_command(command)


async def test_a_command_at_work_goes_on_over_a_break_and_is_begun_once() -> None:
    async with relay(settings()) as server:
        url, program = f"ws://127.0.0.1:{server.port}", Slow()
        robot, operator = Robot(url, "r", program, policy="drop-oldest"), Session(url, "operator")
        async with beside(operator.run(), robot.run()):
            await wait("the robot", robot.client.ready.wait())
            program.works.clear()
            goal = asyncio.ensure_future(operator.command("/robots/r/command", {"command": "goal", "id": "g"}))
            await until("it works", lambda: program.names == ["begins g"])
            robot.client._connection.transport.abort()
            await until("it is away", lambda: not robot.client.ready.is_set())
            await wait("it is back", robot.client.ready.wait())
            program.works.set()
            await wait("its receipt", goal)
            assert program.names == ["begins g", "g"]


async def test_a_stop_outlives_relay_and_robot(tmp_path: Path) -> None:
    """The relay restarts, then the robot, then both, and the stop holds in all; its release does, too."""
    program, url = Program(), ""

    async def life(config: Any, story: Any) -> None:
        async with relay(config) as server:
            operator = Session(f"ws://127.0.0.1:{server.port}", "operator")
            robot = Robot(f"ws://127.0.0.1:{server.port}", "r", program, policy="drop-oldest")
            async with beside(operator.run()), beside(robot.run()):
                await wait("the robot", robot.client.ready.wait())
                await story(operator, robot)

    async def stop(operator: Session, robot: Robot) -> None:
        nonlocal url
        url = await wait("a stop", operator.stop("r"))
        await until("it stands", lambda: robot.latch.is_set)

    async def stands(operator: Session, robot: Robot) -> None:
        await until("it stands", lambda: robot.latch.status == {"id": url, "by": "operator"})
        with pytest.raises(BufgymError, match="stopped by operator"):
            await operator.command("/robots/r/command", {"command": "goal", "id": "g"})

    async def release(operator: Session, robot: Robot) -> None:
        await stands(operator, robot)
        await operator.release("r", url)
        await until("it is free", lambda: not robot.latch.is_set)
        await until(
            "it is written", lambda: [one.get("released_by") for one in robot.status()["stops"]] == ["operator"]
        )

    async def goes(operator: Session, robot: Robot) -> None:
        await operator.command("/robots/r/command", {"command": "goal", "id": "g"})
        assert program.names[-1] == "g"

    kept = settings(folder=tmp_path / "relay")
    await life(kept, stop)
    await life(kept, stands)
    await life(kept, release)
    await life(kept, goes)


async def test_a_relay_that_starts_anew_knows_its_robots(tmp_path: Path) -> None:
    """A command that comes before its robot is back waits for it, although others watch."""
    rule = Rule(address="127.0.0.0/8", send=True, receive=True, command_s=60)
    kept = settings(folder=tmp_path, rules=(rule,))
    async with relay(kept) as server, client(server.port, session="r", robot="r"):
        pass
    async with relay(kept) as server, client(server.port) as watch:
        await watch.subscribe("^/robots/")
        operator = Session(f"ws://127.0.0.1:{server.port}", "operator")
        async with beside(operator.run()):
            goal = asyncio.ensure_future(operator.command("/robots/r/command", {"command": "goal"}))
            await until("it is held", lambda: server.hub.status()["held"] == 1)
            async with client(server.port, session="r", robot="r") as robot:
                await robot_does(robot, 1)
                await wait("its receipt", goal)
