"""What a sender is told is true, also of a robot that ends, is away until the deadline, or has a fault at a stop."""

import asyncio
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cut_cases import cuttable
from loop_cases import beside, compiled
from relay_cases import client, full_disk, nothing, relay, settings, until, wait
from test_stops import COMMAND, RULE, Program

from bufgym.utils.errors import BufgymError
from bufgym_relay import claims, orders
from bufgym_relay.rules import Identity
from bufgym_robot.fleet.kept import Kept
from bufgym_robot.fleet.robot import Robot
from bufgym_robot.wire import backoff
from bufgym_robot.wire.session import Session

pytestmark = compiled


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backoff, "MOST_S", 0.05)


async def sent(operator: Session, id: str = "g") -> str:
    """Send a goal; return why it was not executed, as its sender is told."""
    try:
        await wait("a receipt", operator.command(COMMAND, {"command": "goal", "id": id}))
    except BufgymError as error:
        return str(error)
    return ""


async def goal_in_flight(operator: Session, robot: Any) -> "asyncio.Task[str]":
    """A goal that the robot has been given and has not acked."""
    goal = asyncio.create_task(sent(operator))
    while not getattr(await robot.next(), "no_drop", False):
        pass
    return goal


async def test_a_goal_of_a_robot_that_another_replaced_was_not_surely_executed() -> None:
    """It has ended with the goal, or before it: nobody knows."""
    async with relay(settings()) as server:
        operator = Session(f"ws://127.0.0.1:{server.port}", "operator")
        async with beside(operator.run()):
            async with client(server.port, session="before", robot="r") as robot:
                goal = await goal_in_flight(operator, robot)
            async with client(server.port, session="after", robot="r") as robot:
                assert "nobody knows whether it was executed" in await wait("its receipt", goal)
                assert await nothing(robot)


async def test_a_goal_that_was_given_and_whose_ack_does_not_come_was_not_surely_missed() -> None:
    async with relay(settings(rules=(RULE,))) as server:
        operator = Session(f"ws://127.0.0.1:{server.port}", "operator")
        async with beside(operator.run()):
            async with client(server.port, session="r", robot="r") as robot:
                goal = await goal_in_flight(operator, robot)
            assert "nobody knows whether it was executed" in await wait("its receipt", goal)


async def test_a_goal_that_was_begun_in_time_is_not_late_when_it_comes_again() -> None:
    """The link breaks while it is at work; the relay sends it again, and to the robot its deadline seems over."""
    async with relay(settings()) as server, cuttable(server.port) as link:
        program, operator = Program(), Session(f"ws://127.0.0.1:{server.port}", "operator")
        robot = Robot(f"ws://127.0.0.1:{link.port}", "r", program, policy="drop-oldest")
        async with beside(operator.run(), robot.run()):
            await wait("the robot", robot.client.ready.wait())
            program.works.clear()
            goal = asyncio.create_task(sent(operator))
            await until("it works", lambda: program.at_work)
            link.cut()
            await until("it is away", lambda: not robot.client.connected.is_set())
            robot.client.deadlines.is_late = lambda message: message.until_us > 0  # type: ignore[method-assign]
            link.mend()
            await wait("it is back", robot.client.ready.wait())
            program.works.set()
            assert await wait("its receipt", goal) == "" and program.names == ["g"]


async def test_a_goal_of_a_relay_whose_clock_went_back_is_not_executed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It waits for its robot; the relay ends, and begins an hour earlier, when the deadline is far away."""
    monkeypatch.setattr(claims, "SILENT_S", -1.0)
    kept, now = settings(folder=tmp_path), time.time
    async with relay(kept) as server:
        async with client(server.port, session="r", robot="r"):
            pass
        async with client(server.port, session="ann") as ann:
            await ann.put(COMMAND, b'{"command": "goal"}', encoding="json", seq=1, no_drop=True)
            assert await ann.next() == {"op": "ack", "seq": 1}
    behind: Callable[[], float] = lambda: now() - 3600  # noqa: E731
    monkeypatch.setattr(time, "time", behind)
    async with relay(kept) as server, client(server.port, session="r", robot="r") as robot:
        assert await nothing(robot)
        async with client(server.port, session="ann", acked=1, open=[1]) as ann:
            said = await ann.next()
            assert (said["op"], said["why"]) == ("delivered", "nobody knows whether it was executed")


async def test_a_program_with_a_fault_at_a_stop_stands_all_the_same() -> None:
    class Faulty(Program):
        async def on_command(self, command: Any) -> None:
            if command["command"] == "stop":
                raise ValueError("no brake")

    async with relay(settings()) as server:
        url = f"ws://127.0.0.1:{server.port}"
        robot, operator = Robot(url, "r", Faulty(), policy="drop-oldest"), Session(url, "operator")
        async with beside(operator.run(), robot.run()):
            await wait("the robot", robot.client.ready.wait())
            id = await wait("the stop", operator.stop("r"))
            await until("it is written down", lambda: [stop["id"] for stop in robot.status()["stops"]] == [id])
            await until("an answer", lambda: robot.status()["answer"] == {"id": id, "why": "ValueError: no brake"})
            assert json.loads(robot._kept.path.read_text())["stops"][0]["id"] == id


async def test_what_a_full_disk_did_not_take_is_written_later(tmp_path: Path) -> None:
    """By the relay and by the robot: both restart, and the stop holds."""
    async with relay(settings(folder=tmp_path)) as server:
        url = f"ws://127.0.0.1:{server.port}"
        robot, operator = Robot(url, "r", Program(), policy="drop-oldest"), Session(url, "operator")
        async with beside(operator.run(), robot.run()):
            await wait("the robot", robot.client.ready.wait())
            with full_disk():
                with pytest.raises(BufgymError, match="it is in force, but lost when the relay restarts"):
                    await wait("the stop", operator.stop("r"))
                await until("it stands", lambda: robot.latch.is_set)
                await until("it cannot be written", lambda: robot._kept.is_behind)
                assert robot.status()["unwritten"] is True  # so nobody who says it takes it as kept
            await until("it is written", lambda: not robot._kept.is_behind)
            assert "unwritten" not in robot.status()
            await until("it is written here, too", lambda: not server.hub.desk._unwritten)
    assert Kept(robot._kept.path).load().held
    async with relay(settings(folder=tmp_path)) as server:
        assert server.hub.orders.ledgers["r"].held


async def test_stops_of_many_names_keep_none_from_a_robot_that_is_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its operator is at the same address as the client that says them."""
    monkeypatch.setattr(orders, "MOST_ROBOTS", 20)
    async with relay(settings()) as server, client(server.port, name="odd") as odd:
        url = f"ws://127.0.0.1:{server.port}"
        robot, operator = Robot(url, "r", Program(), policy="drop-oldest"), Session(url, "operator")
        async with beside(operator.run(), robot.run()):
            await wait("the robot", robot.client.ready.wait())
            for k in range(30):
                stop = json.dumps({"command": "stop", "id": f"odd-{k + 1}"}).encode()
                await odd.put(f"/robots/x{k}/stop", stop, encoding="json", seq=k + 1)
            assert [said.get("code") for said in await odd.rest()].count("too_many") == 10
            id = await wait("a stop", operator.stop("r"))
            await until("it stands", lambda: robot.latch.is_set)
            await wait("its release", operator.release("r", id))
            await until("it is free", lambda: not robot.latch.is_set)
            assert len(server.hub.orders.ledgers) == len(server.hub.desk.said) == 20


async def test_a_welcome_counts_what_the_last_connection_has_begun(tmp_path: Path) -> None:
    """It breaks while its message waits for the disk: the next one must not give another message this number."""
    async with relay(settings(folder=tmp_path)) as server, client(server.port, session="r", robot="r"):
        async with client(server.port, session="ann") as ann:
            work = server.hub.store.disk.do(time.sleep, 0.5)
            await ann.put(COMMAND, b'{"command": "cancel"}', encoding="json", seq=1, no_drop=True)
            await until("it waits", lambda: server.hub.holding._running)
            ann.socket.transport.abort()
        async with client(server.port, session="ann") as ann:
            assert ann.welcome["received"] == 1
        await wait("the disk", work)


async def test_a_command_that_was_dropped_is_not_executed_by_the_ack_of_the_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The disk is at work meanwhile, so acks of the first and the third are written together."""
    async with relay(settings()) as server:
        store, who = server.hub.store, Identity("127.0.0.1")
        ann, robot = (store.open(name, who, False, 0, 0) for name in ("ann", "r"))
        for number in range(1, 6):
            await store.hold(ann, number, COMMAND, b"", [robot])
        work = store.disk.do(time.sleep, 0.3)
        store.acked(robot, 1)
        store.denied(robot, 2, "came too late")
        store.acked(robot, 3)
        await wait("the disk", work)
        await until("outcomes", lambda: 3 in ann.outcomes)
        assert [ann.outcomes[number].why for number in (1, 2, 3)] == ["", "came too late", ""]

        settle = store._held._settle

        def settled(*words: Any) -> None:
            settle(*words)
            if words[2] == 4:  # its robot refuses the next one in this moment
                robot.answers[5], robot.acked = "the way is blocked", 5

        monkeypatch.setattr(store._held, "_settle", settled)
        store.acked(robot, 4)
        await until("an outcome", lambda: 4 in ann.outcomes)
        store.acked(robot, 5)
        await until("an outcome", lambda: 5 in ann.outcomes)
        assert ann.outcomes[5].why == "the way is blocked"
