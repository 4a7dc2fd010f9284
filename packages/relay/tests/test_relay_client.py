"""The client: what the relay has not answered, by hand; a queue over a link that breaks; tokens and addresses."""

import asyncio
import contextlib
import json
import math
import re
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from loop_cases import beside, compiled
from refusal_cases import refuse
from relay_cases import Corner, client, relay, settings, until, wait, within

from bufgym.model.link import Link
from bufgym.model.topics import Topic
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError
from bufgym_robot.fleet.client import RobotClient
from bufgym_robot.shaped import ShapedLink
from bufgym_robot.wire import backoff
from bufgym_robot.wire.address import parsed, security, token
from bufgym_robot.wire.messages import Message, RefusedError
from bufgym_robot.wire.session import Session
from bufgym_robot.wire.sockets import free_port
from bufgym_robot.wire.unanswered import Unanswered


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backoff, "MOST_S", 0.01)


async def test_a_refused_number_is_used_again() -> None:
    """Window 3: 1 is acked, 2 refused, 3 and 4 come back as out of order, and go again as 2 and 3."""
    unanswered = Unanswered()
    unanswered.window = 3

    def sent() -> tuple[int, bytes] | None:
        message = unanswered.next()
        return None if message is None else (message.seq, bytes(message.payload))

    futures = [unanswered.put(Message("/a", str(k).encode())) for k in range(5)]
    assert [sent() for _ in range(4)] == [(1, b"0"), (2, b"1"), (3, b"2"), None]
    unanswered.ack(1)
    assert sent() == (4, b"3")
    assert unanswered.expects("/a", 2) and not unanswered.expects("/a", 3) and not unanswered.expects("/b", 2)
    unanswered.refuse("store_full", "no room")
    assert sent() is None and unanswered.expects("/a", 3)
    unanswered.refuse("out_of_order", "2 first")
    assert sent() is None  # 4 is still to come back
    unanswered.refuse("out_of_order", "2 first")
    assert [sent() for _ in range(3)] == [(2, b"2"), (3, b"3"), (4, b"4")]
    unanswered.ack(4)
    assert unanswered.next() is None and all(future.done() for future in futures)
    with pytest.raises(BufgymError, match="topic /a: refused: store_full: no room"):
        await futures[1]


async def test_after_a_reconnect_what_the_relay_lacks_goes_again() -> None:
    unanswered = Unanswered()
    unanswered.window = 4
    futures = [unanswered.put(Message("/a", str(k).encode())) for k in range(4)]
    assert all(unanswered.next() for _ in range(4))
    unanswered.resume(received=2, window=1)
    assert [future.done() for future in futures] == [True, True, False, False]
    assert unanswered.next() == Message("/a", b"2", seq=3) and unanswered.next() is None
    unanswered.give_up("the client has ended")
    with pytest.raises(BufgymError, match="has ended"):
        await futures[3]


async def test_a_command_that_was_sent_and_is_late_after_a_break_may_have_been_executed() -> None:
    """Two were put before the break, of which one was sent; of that one nobody knows."""
    late = False

    def dated(message: Message, put_s: float) -> Message:
        if late:
            raise BufgymError("too late")
        return message

    unanswered = Unanswered(dated)
    sent, waited = (unanswered.put(Message("/a", name)) for name in (b"sent", b"waited"))
    assert unanswered.next() is not None and unanswered.next() is None
    late = True
    unanswered.resume(received=0, window=1)
    assert unanswered.next() is None
    assert str(sent.exception()) == "too late: nobody knows whether it was executed"
    assert str(waited.exception()) == "too late"


@contextlib.asynccontextmanager
async def links(corner: Corner, count: int) -> AsyncIterator[list[Any]]:
    """Links of 10 MB/s to the relay, and the URLs where they begin."""
    fast = Link(Trace.constant(1e7, duration_s=10))
    made = [ShapedLink(fast, ("127.0.0.1", corner.port)) for _ in range(count)]
    try:
        yield [(link, f"ws://127.0.0.1:{await link.listen()}") for link in made]
    finally:
        for link in made:
            await link.close()


async def cut(link: ShapedLink, end: Session) -> None:
    """Break its connection, and mend it when it has been noticed."""
    faults = len(end.faults)
    link.cut()
    await until("the break to be noticed", lambda: len(end.faults) > faults)
    link.mend()


@compiled
async def test_commands_come_once_and_in_order_over_a_link_that_breaks(corner: Corner) -> None:
    """20 commands, one at a time, while the sender's and the receiver's link are cut in turn."""
    came: list[int] = []
    async with links(corner, 2) as ((near, sends), (far, receives)):
        sender, receiver = Session(sends, "a"), Session(receives, "b")
        async with beside(sender.run()):
            with pytest.raises(BufgymError, match=f"topic {corner.command}: refused: no_receiver"):
                await wait("the refusal", sender.command(corner.command, {"command": "stop"}))
        sender = Session(sends, "a")
        receiver.subscribe(f"^{corner.command}$", lambda one: came.append(json.loads(bytes(one.payload))), durable=True)
        async with within("20 commands"), beside(sender.run(), receiver.run()):
            await receiver.ready.wait()
            for k in range(20):
                cuts = [cut(near, sender) if k % 2 else cut(far, receiver)] if k % 5 == 2 else []
                async with beside(*cuts) as cutting:
                    await sender.command(corner.command, k)
                    await asyncio.gather(*cutting)
            await until("the last", lambda: len(came) >= 20)
            assert sender.faults and receiver.faults
    assert came == list(range(20))


@compiled
async def test_a_queue_over_a_break_and_a_change_of_policy(corner: Corner) -> None:
    """What is queued when the policy changes goes all the same; the numbers of what comes rise."""
    came: list[Message] = []
    records: list[tuple[int, str]] = []
    topic = corner.topic("camera")
    async with links(corner, 1) as ((link, url),):
        about: dict[str, Any] = {"topics": (Topic(topic),), "policy": "drop-newest", "capacity": 8}
        robot = RobotClient(url, "a", **about, log=lambda number, record: records.append((number, record["event"])))
        viewer = Session(corner.url, "v")
        viewer.subscribe(f"^{topic}$", came.append)
        async with within("what was queued"), beside(viewer.run(), robot.run()):
            await viewer.ready.wait()
            await robot.ready.wait()
            for policy in ("drop-oldest", None):
                for _ in range(8):
                    robot.publish(topic, bytes(4_000), "jpeg")
                if policy is not None:
                    robot.change(policy)
            await until("all 16", lambda: len(came) == 16)
            assert {number for number, _ in records} == {0, 1} and (1, "dropped") not in records
            await cut(link, robot)
            while len(came) == 16:  # what the link itself held when it broke is lost
                robot.publish(topic, bytes(4_000), "jpeg")
                await robot.ready.wait()
                await until("an empty queue", lambda: not robot.queue.in_flight)
    assert all(message.sender == "a" and message.encoding == "jpeg" for message in came)
    assert [message.seq for message in came[:16]] == list(range(1, 17)) and came[-1].seq > 16


@compiled
@pytest.mark.parametrize("window", [2, None])
async def test_a_message_is_on_its_way_until_the_relay_answers_the_ping_behind_it(
    corner: Corner, window: int | None
) -> None:
    """The relay's system acks at once, and PONGs are late. A window waits for PONGs; without one all go."""
    came: list[int] = []
    pongs: list[asyncio.Future[float]] = []
    topic = corner.topic("camera")
    robot = RobotClient(corner.url, "a", topics=(Topic(topic),), policy="drop-newest", capacity=8, window=window)
    viewer = Session(corner.url, "v")
    viewer.subscribe(f"^{topic}$", lambda message: came.append(message.seq))

    async def ping() -> asyncio.Future[float]:
        pongs.append(asyncio.get_running_loop().create_future())
        return pongs[-1]

    async with within("messages"), beside(viewer.run(), robot.run()):
        await viewer.ready.wait()
        await robot.ready.wait()
        robot._connection.ping = ping
        for _ in range(4):
            robot.publish(topic, b"1")
        if window is None:
            await until("all to arrive", lambda: came == [1, 2, 3, 4] and robot.queue.in_flight == 0)
            assert len(robot._away) == 4  # which would be sent again after a break
            return
        await until("two to arrive", lambda: len(came) == 2)
        await asyncio.sleep(0.1)  # time in which a third could
        assert (came, robot.queue.in_flight, len(robot.queue)) == ([1, 2], 2, 2)
        pongs[0].set_result(0.1)
        await until("the third", lambda: len(came) == 3)
        assert (robot.queue.in_flight, len(pongs)) == (2, 3)


@compiled
async def test_another_relay_stands_in_while_home_is_away(tmp_path: Path) -> None:
    """Pictures and ordinary subscriptions go over it. Commands wait for home, and arrive there once."""
    ours, camera, command = (
        settings(port=free_port("127.0.0.1"), folder=tmp_path),
        "/robots/r/camera",
        "/robots/r/command",
    )
    commands, news = list[int](), list[bytes]()
    async with relay() as other, client(other.port) as viewer:
        urls = f"ws://127.0.0.1:{ours.port},ws://127.0.0.1:{other.port}"
        robot = RobotClient(urls, "r", topics=(Topic(camera),), policy="drop-oldest")
        robot.subscribe(f"^{command}$", lambda one: commands.append(json.loads(bytes(one.payload))), durable=True)
        robot.subscribe("^/news$", lambda one: news.append(bytes(one.payload)))
        await viewer.subscribe("camera")
        async with within("both relays"), beside(robot.run()):
            async with relay(ours), client(ours.port, session="receiver") as receiver:
                await receiver.subscribe("^/robots/other/command$", durable=True)
                await until("home", lambda: robot.ready.is_set() and not robot.stands_in)
            await until("the other", lambda: robot.ready.is_set() and robot.stands_in)
            robot.publish(camera, b"picture", "raw")
            assert bytes((await viewer.next()).payload) == b"picture"
            await viewer.put("/news", b"all is well")
            await until("the news", lambda: news)
            await viewer.command(1, command)
            assert (await viewer.next())["code"] == "no_receiver"
            waiting = asyncio.ensure_future(robot.command("/robots/other/command", 7))
            async with relay(ours), client(ours.port) as operator:
                await operator.acked(command, 1)
                await until("the command", lambda: commands)
                async with client(ours.port, session="receiver") as receiver:
                    await receiver.came(1, payload=b"7")
                    assert not waiting.done()
                    await receiver.say("ack", seq=1)
                    await wait("its receipt", waiting)
                    assert not [one for one in await receiver.rest() if isinstance(one, Message)]
    assert commands == [1]


async def test_who_is_not_let_in_is_told_why(corner: Corner) -> None:
    """An address without a rule is not talked to, and tries again; one whose token is no good gives up."""
    async with relay(settings(rules=())) as server:
        untrusted = Session(f"ws://127.0.0.1:{server.port}", "untrusted")
        async with beside(untrusted.run()):
            await until("another try", lambda: len(untrusted.faults) > 1)
        assert "HTTP 403" in untrusted.faults[0] and "no rule" in untrusted.faults[0]
    with pytest.raises(RefusedError, match=r"ws://127.0.0.1:\d+: refused: unauthorized: token"):
        await wait("the refusal", Session(corner.url, "untrusted", token="x.y.z").run())


def test_tokens_addresses_and_certificates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("BUFGYM_RELAY_TOKEN", raising=False)
    assert token() is None
    monkeypatch.setenv("BUFGYM_RELAY_TOKEN", "one")
    (tmp_path / "token").write_text("two\n")
    assert token() == "one" and token(tmp_path / "token") == "two"
    for url in ("robot:7420", "ws://a:99999", "ws://a:x", "ws://[::1"):
        refuse(f"{re.escape(url)}: must be ws://HOST:PORT", Session, f"ws://b:1,{url}", "a")
    assert [parsed(f"wss://a{path}").path for path in ("", "/", "/relay/", "/fleet/relay")] == ["", "", "", "/fleet"]
    refuse("topic '/c': data must be JSON: Out of range", asyncio.run, Session("ws://a:1", "a").command("/c", math.nan))
    assert security() is None
    refuse("token: no certificate", security, certificate=str(tmp_path / "token"))
    refuse(r"pattern '\[': unterminated", Session("ws://a:1", "a").subscribe, "[", print)
    refuse("topic '/b': this client publishes nothing", RobotClient("ws://a:1", "a").publish, "/b", b"")
