"""Clients outlive whatever ends their connections, refusals that pass, and messages that are too large."""

import asyncio
import contextlib
import itertools
import socket
import struct
from typing import Any

import pytest
from loop_cases import beside, compiled
from relay_cases import Corner, relay, settings, until, wait, within

from bufgym.model.topics import Topic
from bufgym_relay.config import Limits
from bufgym_relay.connection import Connection
from bufgym_robot.fleet.client import RobotClient
from bufgym_robot.wire import backoff, inbox
from bufgym_robot.wire.messages import Message, RefusedError
from bufgym_robot.wire.session import Session
from bufgym_robot.wire.tasks import until_one_ends


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backoff, "MOST_S", 0.01)


def shut(accepted: Any, how: str) -> None:
    """End a client's connection from the relay's side, or say nothing more on it."""
    tcp = accepted.transport.get_extra_info("socket")
    if how == "FIN":
        tcp.shutdown(socket.SHUT_WR)
    elif how == "RST":
        tcp.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        accepted.transport.abort()
    elif how == "silence":
        accepted.transport.pause_reading()
    else:
        accepted.protocol.fail(int(how))
        accepted.send_data()


def hurry(connection: Any) -> None:
    """Ping, and give up without an answer or in silence, 500 times as fast as until now."""
    connection.keepalive_task.cancel()
    for name in ("ping_interval", "ping_timeout", "close_timeout"):
        setattr(connection, name, getattr(connection, name) / 500)
    connection.start_keepalive()


@compiled
@pytest.mark.parametrize("how", ["FIN", "RST", "1009", "silence"])
async def test_a_client_outlives_any_end_of_its_connection(
    how: str, corner: Corner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At each of its sends, pings and receipts in turn its connection ends. It comes back, and sends what it has to."""
    topic, came, commands, connect = corner.topic("camera"), set[int](), list[bytes](), Session._connect
    async with corner.client() as viewer:
        for id, name in (("a", "camera"), ("b", "command")):
            await viewer.subscribe(f"^{corner.topic(name)}$", id)

        async def watch() -> None:
            while True:
                if (one := await viewer.next()).no_drop:
                    commands.append(bytes(one.payload))
                    await viewer.say("ack", seq=one.seq)
                else:
                    came.add(one.seq)

        others, ended, moments, n = set(corner.server._admission.open), list[Any](), 0, 0

        def counted(function: Any) -> Any:
            async def call(*words: Any) -> Any:
                nonlocal moments
                moments += 1
                for accepted in corner.server._admission.open - others if moments == n else ():
                    shut(accepted, how)
                    ended.append(accepted)
                    if how == "silence":
                        hurry(function.__self__)
                return await function(*words)

            return call

        async def opened(self: Session) -> Any:
            connection = await connect(self)
            for name in ("send", "ping", "recv"):
                setattr(connection, name, counted(getattr(connection, name)))
            return connection

        monkeypatch.setattr(Session, "_connect", opened)
        async with beside(watch()) as watching:
            while moments >= n:
                n, moments = n + 1, 0
                robot = RobotClient(corner.url, "a", topics=(Topic(topic),), policy="drop-newest", capacity=8)
                robot.subscribe("^/nothing$", print)
                came.clear()
                robot.publish(topic, bytes(200_000), "jpeg")
                async with within(f"{how} at {n}"), beside(robot.run()):
                    await robot.command(corner.command, n)
                    await robot.ping()
                    await until("the picture", lambda: came)
                for accepted in ended:
                    accepted.transport.resume_reading()
                await until("its end", lambda: len(corner.hub.members) == 1)
            await until("the commands", lambda: len(commands) >= n)
            watching[0].cancel()
    assert n >= 8 and commands == [b"%d" % k for k in range(1, n + 1)]


@compiled
async def test_what_is_too_large_is_refused_by_its_size(corner: Corner) -> None:
    """1 kB at most. What was put before the relay said so fails then, and what is behind it goes."""
    camera, came = corner.topic("camera"), list[Message]()
    async with relay(settings(limits=Limits(message_bytes=1_000))) as server:
        robot, viewer = (RobotClient(f"ws://127.0.0.1:{server.port}", name, topics=(Topic(camera),)) for name in "ab")
        viewer.subscribe(f"^/robots/{corner.robot}/", came.append)
        robot.publish(camera, bytes(1_000), "jpeg")
        early = [asyncio.ensure_future(robot.command(corner.command, text)) for text in ("a" * 1_000, "stop")]
        async with beside(viewer.run()) as running:
            await wait("the viewer", viewer.ready.wait())
            running.append(asyncio.ensure_future(robot.run()))
            with pytest.raises(RefusedError, match=f"topic {corner.command}: 10.. bytes: must be at most 1000"):
                await wait("the refusal", early[0])
            await wait("the stop", early[1])
            with pytest.raises(RefusedError, match=f"topic {camera}: 10.. bytes: must be at most 1000"):
                robot.publish(camera, bytes(1_000), "jpeg")
            with pytest.raises(RefusedError, match="must be at most 1000"):
                await robot.command(corner.command, "a" * 1_000)
            robot.publish(camera, b"picture", "jpeg")
            await until("the picture", lambda: sorted(bytes(one.payload) for one in came) == [b'"stop"', b"picture"])
            assert [fault for fault in robot.faults if "must be at most" not in fault] == []


@pytest.mark.parametrize(
    ("code", "proof", "ends"),
    [
        *((code, None, False) for code in ("too_many", "too_fast", "too_slow", "store_full", "unavailable")),
        *((code, None, True) for code in ("unauthorized", "wrong")),
        *((code, lambda: None, code == "wrong") for code in ("unauthorized", "wrong")),
    ],
)
async def test_what_waiting_mends_ends_no_client(
    code: str, proof: Any, ends: bool, corner: Corner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second connection is refused, and the third is let in. A token that can be read again may have ended."""
    greet, tries = Connection.greet, itertools.count(1)

    async def refusing(caller: Any) -> Any:
        admitted = await greet(caller)
        if next(tries) == 2:
            raise RefusedError(code, "not now")
        return admitted

    monkeypatch.setattr(Connection, "greet", staticmethod(refusing))
    one = Session(corner.url, "a", token=proof)

    async def break_off() -> None:
        await one.ready.wait()
        one._connection.transport.abort()
        await until("a refusal", lambda: not one.ready.is_set())
        await one.ready.wait()

    ending = pytest.raises(RefusedError, match=f"refused: {code}: not now") if ends else contextlib.nullcontext()
    with ending:
        await wait("the third connection", until_one_ends(one.run(), break_off()))
    assert ends or any(f"refused: {code}: not now" in fault for fault in one.faults)


@pytest.mark.parametrize("fault", [ValueError, asyncio.CancelledError])
async def test_a_fault_in_the_program_ends_no_client(corner: Corner, fault: type[BaseException]) -> None:
    """It is reported as asyncio reports faults, and the next command comes; also where nobody reads what it says."""
    came, faults = list[bytes](), list[Any]()

    def take(message: Message) -> None:
        came.append(bytes(message.payload))
        raise fault("a fault")

    def say(text: str) -> None:
        raise BrokenPipeError

    asyncio.get_running_loop().set_exception_handler(lambda loop, about: faults.append(about["exception"]))
    one = Session(corner.url, "a", say=say)
    one.note("a fault")
    one.subscribe(f"^{corner.command}$", take)
    async with beside(one.run()), corner.client() as operator:
        await wait("its subscription", one.ready.wait())
        for seq in (1, 2):
            await operator.command(seq, corner.command)
        await until("both", lambda: came == [b"1", b"2"])
    asyncio.get_running_loop().set_exception_handler(None)
    assert [str(fault) for fault in faults] == ["a fault", "a fault"]


async def test_what_a_message_calls_may_wait_for_an_answer(corner: Corner, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program answers each report with a command, while reports come on that it has no room for: the newest stays."""
    monkeypatch.setattr(inbox, "MOST_BYTES", 1_000)
    one, came, answers = Session(corner.url, "a"), list[bytes](), 0

    async def answer(message: Message) -> None:
        nonlocal answers
        came.append(bytes(message.payload[:1]))
        await one.command(corner.command, len(came))
        answers += 1

    one.subscribe(f"^{corner.topic('report')}$", answer, policy="drop-oldest", capacity=100)
    taker = Session(corner.url, "b", robot=corner.robot)
    taker.subscribe(f"^{corner.command}$", lambda message: None)
    async with beside(one.run(), taker.run()), corner.client() as robot:
        await wait("the robot", taker.ready.wait())
        await wait("its subscription", one.ready.wait())
        held, hold = asyncio.Event(), corner.hub.hold

        async def late(*words: Any, **named: Any) -> None:
            await held.wait()
            await hold(*words, **named)

        monkeypatch.setattr(corner.hub, "hold", late)
        for k in range(9):
            await robot.put(corner.topic("report"), b"%d" % k + bytes(600))
        await until("all are read", lambda: b"8" in [bytes(each.payload[:1]) for each in one._inbox._waiting])
        assert len(one._inbox._waiting) <= 3
        held.set()
        await until("the last answer", lambda: answers == len(came) and came[-1] == b"8")
        assert came[0] == b"0" and len(came) <= 4
