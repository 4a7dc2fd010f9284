"""Relay, robot, operators and NATS restart at random moments while links break, with stops and goals under way.

No stop is lost and none comes back; no goal is executed late, twice, or while a stop holds; each answer is true.
"""

import asyncio
import contextlib
from pathlib import Path
from typing import Any

import pytest
import ros_program
from loop_cases import beside, compiled
from needs import needs

for library in ("websockets", "re2"):
    pytest.importorskip(library, reason=needs("extras", library))

from nats_cases import connected, nats_server, needs_server  # noqa: E402
from relay_cases import process, settings, until, wait  # noqa: E402
from restart_cases import RULE, begun, play, played  # noqa: E402
from restart_truth import DEADLINE_S  # noqa: E402
from test_stops import COMMAND, Program  # noqa: E402

from bufgym.utils.errors import BufgymError  # noqa: E402
from bufgym_relay import Nats, claims  # noqa: E402
from bufgym_relay.config import Config, Rule  # noqa: E402
from bufgym_robot.fleet.robot import Robot  # noqa: E402
from bufgym_robot.wire import backoff  # noqa: E402
from bufgym_robot.wire.session import Session  # noqa: E402
from bufgym_robot.wire.sockets import free_port  # noqa: E402

pytestmark = compiled
OTHERS = Rule(nats=True, send=True, receive=True, topic="/robots/.*", command_s=DEADLINE_S)
ROUNDS = [4, pytest.param(200, marks=pytest.mark.nightly)]
FEW_ROUNDS = [2, pytest.param(200, marks=pytest.mark.nightly)]
long = pytest.mark.timeout(1200)


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(backoff, "MOST_S", 0.05)
    monkeypatch.setattr(claims, "SILENT_S", 1.0)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@long
@pytest.mark.parametrize("rounds", ROUNDS)
async def test_a_relay_that_restarts(rounds: int, tmp_path: Path, seed: int = 1) -> None:
    port = free_port("127.0.0.1")
    config = settings(port=port, rules=(RULE,), folder=tmp_path / "relay")
    async with begun(config) as one, played(port, port, seed) as field:
        field.shakes["relay"] = one.again
        await play(field, rounds, seed)


class Killed:
    """A relay in a process that is killed, and started anew."""

    def __init__(self, port: int, folder: Path) -> None:
        self._port, self._folder, self._stack = port, folder, contextlib.AsyncExitStack()

    async def end(self) -> None:
        await self._stack.aclose()

    async def again(self) -> None:
        await self.end()
        await self._stack.enter_async_context(process(self._port, self._folder, command_s=DEADLINE_S))


@pytest.mark.nightly
@long
@pytest.mark.parametrize("rounds", [200])
async def test_a_relay_that_is_killed(rounds: int, tmp_path: Path, seed: int = 2) -> None:
    port = free_port("127.0.0.1")
    one = Killed(port, tmp_path)
    await one.again()
    try:
        async with played(port, port, seed) as field:
            field.shakes["relay killed"] = one.again
            await play(field, rounds, seed)
    finally:
        await one.end()


@needs_server
@long
@pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")  # of the library nats
@pytest.mark.parametrize("rounds", FEW_ROUNDS)
async def test_two_relays_over_nats(rounds: int, tmp_path: Path, seed: int = 3) -> None:
    """The robot is at one, the operators at the other. NATS is killed, too."""
    at, ports = free_port("127.0.0.1"), [free_port("127.0.0.1") for _ in range(2)]

    def config(port: int, name: str) -> Config:
        where: Any = Nats(f"nats://127.0.0.1:{at}", name)
        return settings(port=port, rules=(RULE, OTHERS), folder=tmp_path / name, nats=where)

    async with contextlib.AsyncExitStack() as stack:
        near, far = config(ports[0], "near"), config(ports[1], "far")
        nats = await stack.enter_async_context(contextlib.AsyncExitStack())

        async def nats_again() -> None:
            await nats.aclose()
            await nats.enter_async_context(nats_server(at, tmp_path / "nats"))

        await nats_again()
        relays = [await stack.enter_async_context(begun(one)) for one in (near, far)]
        await connected(*(one.server for one in relays))
        field = await stack.enter_async_context(played(ports[1], ports[0], seed))
        field.shakes |= {"near relay": relays[0].again, "far relay": relays[1].again, "NATS": nats_again}
        await play(field, rounds, seed)


@long
@pytest.mark.parametrize("rounds", [2, pytest.param(100, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("version", ["1", "2"])
def test_a_robot_of_ros(version: str, rounds: int, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    """Its process is ended and killed. What it executes is what another node hears of it."""
    seen, _ = ros_program.run(request, "ros_restarts_session.py", version, tmp_path, rounds, rounds, limit_s=1150)
    assert seen["rounds"] == rounds and seen["robot ended"] and seen["robot killed"] and seen["goals executed"]


@needs_server
async def test_a_goal_that_nats_held_for_a_relay_that_was_away_is_not_executed_late(tmp_path: Path) -> None:
    """The relay at the robot has restarted, and heard nothing of the clock that alone says how old the goal is."""
    at, program = free_port("127.0.0.1"), Program()

    def config(name: str, port: int = 0) -> Config:
        where: Any = Nats(f"nats://127.0.0.1:{at}", name)
        return settings(port=port, rules=(RULE, OTHERS), folder=tmp_path / name, nats=where)

    port = free_port("127.0.0.1")
    async with nats_server(at, tmp_path / "nats"), begun(config("near")) as near, begun(config("far", port)) as far:
        await connected(near.server, far.server)
        operator = Session(f"ws://127.0.0.1:{near.server.port}", "operator")
        robot = Robot(f"ws://127.0.0.1:{port}", "r", program, policy="drop-oldest")
        async with beside(operator.run(), robot.run()):
            await wait("the robot", robot.client.ready.wait())
            await wait("a goal", operator.command(COMMAND, {"command": "goal", "id": "in time"}))
            await far.end()
            late = asyncio.create_task(operator.command(COMMAND, {"command": "goal", "id": "late"}))
            await asyncio.sleep(2 * DEADLINE_S)
            await far.begin()
            with pytest.raises(BufgymError, match=r"s after its deadline|nobody knows whether it was executed"):
                await wait("its receipt", late)
            await until("another goal", lambda: robot.client.ready.is_set())
            await wait("a goal", operator.command(COMMAND, {"command": "goal", "id": "next"}))
            assert program.names == ["in time", "next"]
