"""The client: what the relay has not answered, by hand; a queue over a link that breaks; tokens and addresses."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
from relay_cases import relay, settings

from bufgym.errors import BufgymError
from bufgym.kernel import JIT
from bufgym.live.shaped import ShapedLink
from bufgym.model.link import Link
from bufgym.model.topics import Topic
from bufgym.relay.client import Client
from bufgym.relay.session import RefusedError, Session, security, token
from bufgym.relay.unanswered import Unanswered
from bufgym.relay.wire import Message
from bufgym.traces import Trace

compiled = pytest.mark.skipif(not JIT, reason="uncompiled, decisions take as long as messages do")
COMMAND = "/robots/a/command"


async def until(holds: Any, timeout_s: float = 30.0) -> None:
    """Returns once ``holds()``."""
    async with asyncio.timeout(timeout_s):
        while not holds():
            await asyncio.sleep(0.01)


# --- what is not answered --------------------------------------------------------------------------------------------


def test_a_refused_number_is_used_again() -> None:
    """Window 3: 1 is acked, 2 refused, 3 and 4 come back as out of order, and go again as 2 and 3."""

    async def story() -> None:
        unanswered = Unanswered()
        unanswered.window = 3
        futures = [unanswered.put(Message("/a", str(k).encode())) for k in range(5)]
        sent = [unanswered.next() for _ in range(4)]
        assert [message and (message.seq, message.payload) for message in sent] == [
            (1, b"0"),
            (2, b"1"),
            (3, b"2"),
            None,
        ]
        unanswered.ack(1)
        assert unanswered.next() == Message("/a", b"3", seq=4)
        assert unanswered.expects("/a", 2) and not unanswered.expects("/a", 3) and not unanswered.expects("/b", 2)
        unanswered.refuse("store_full", "no room")
        assert unanswered.next() is None and unanswered.expects("/a", 3)
        unanswered.refuse("out_of_order", "2 first")
        assert unanswered.next() is None  # 4 is still to come back
        unanswered.refuse("out_of_order", "2 first")
        sent = [unanswered.next() for _ in range(3)]
        assert [message and (message.seq, message.payload) for message in sent] == [(2, b"2"), (3, b"3"), (4, b"4")]
        unanswered.ack(4)
        assert len(unanswered) == 0 and [future.done() for future in futures] == [True] * 5
        with pytest.raises(BufgymError, match="topic /a: refused: store_full: no room"):
            await futures[1]

    asyncio.run(story())


def test_after_a_reconnect_what_the_relay_lacks_goes_again() -> None:
    async def story() -> None:
        unanswered = Unanswered()
        unanswered.window = 4
        futures = [unanswered.put(Message("/a", str(k).encode())) for k in range(4)]
        assert [unanswered.next() is not None for _ in range(4)] == [True] * 4
        unanswered.resume(received=2, window=1)
        assert [future.done() for future in futures] == [True, True, False, False]
        assert unanswered.next() == Message("/a", b"2", seq=3) and unanswered.next() is None
        unanswered.give_up("the client has ended")
        with pytest.raises(BufgymError, match="has ended"):
            await futures[3]

    asyncio.run(story())


# --- over real connections -------------------------------------------------------------------------------------------


@compiled
def test_commands_come_once_and_in_order_over_a_link_that_breaks() -> None:
    """30 commands, one at a time, while the sender's and the receiver's link are cut in turn."""
    came: list[int] = []

    async def story() -> None:
        async with relay(settings()) as server:
            fast = Link(Trace.constant(1e8, duration_s=10))
            links = [ShapedLink(fast, ("127.0.0.1", server.port)) for _ in range(2)]
            ends = [
                Session(f"ws://127.0.0.1:{await link.listen()}", name) for link, name in zip(links, "ab", strict=True)
            ]
            sender, receiver = ends
            receiver.subscribe(
                f"^{COMMAND}$", lambda message: came.append(json.loads(bytes(message.payload))), durable=True
            )
            tasks = [asyncio.create_task(end.run()) for end in ends]
            await asyncio.gather(*(end.ready.wait() for end in ends))

            async def cuts() -> None:
                for k in range(4):
                    link, faults = links[k % 2], ends[k % 2].faults
                    await asyncio.sleep(0.15)
                    met = len(faults)
                    link.cut()
                    while len(faults) == met:  # noticed, however slow the machine is
                        await asyncio.sleep(0.02)
                    link.mend()

            cutting = asyncio.create_task(cuts())
            for k in range(30):
                await sender.command(COMMAND, k)
                await asyncio.sleep(0.02)
            await cutting
            await until(lambda: len(came) >= 30)
            assert sender.faults and receiver.faults
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            for link in links:
                await link.close()

    asyncio.run(story())
    assert came == list(range(30))


@compiled
def test_a_queue_over_a_break_and_a_change_of_policy() -> None:
    """What is queued when the policy changes goes all the same; the numbers of what comes rise."""
    came: list[Message] = []
    records: list[tuple[int, str]] = []

    async def story() -> None:
        async with relay(settings()) as server:
            link = ShapedLink(Link(Trace.constant(40_000.0, duration_s=10)), ("127.0.0.1", server.port))
            robot = Client(
                f"ws://127.0.0.1:{await link.listen()}",
                "a",
                topics=(Topic("/robots/a/camera"),),
                policy="drop-newest",
                capacity=8,
                log=lambda number, record: records.append((number, record["event"])),
            )
            viewer = Session(f"ws://127.0.0.1:{server.port}", "v")
            viewer.subscribe("^/robots/a/camera$", came.append)
            tasks = [asyncio.create_task(end.run()) for end in (viewer, robot)]
            await asyncio.gather(viewer.ready.wait(), robot.ready.wait())
            for _ in range(8):
                robot.publish("/robots/a/camera", bytes(4_000), "jpeg")
            robot.change("drop-oldest")
            for _ in range(8):
                robot.publish("/robots/a/camera", bytes(4_000), "jpeg")
            await until(lambda: len(came) == 16)
            assert {number for number, _ in records} == {0, 1} and (1, "dropped") not in records
            link.cut()
            await until(lambda: robot.faults)
            link.mend()
            while len(came) == 16:  # what the link itself held when it broke is lost
                robot.publish("/robots/a/camera", bytes(4_000), "jpeg")
                await asyncio.sleep(0.05)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await link.close()

    asyncio.run(story())
    assert all(message.sender == "a" and message.encoding == "jpeg" for message in came)
    assert [message.seq for message in came[:16]] == list(range(1, 17)) and came[-1].seq > 16


def test_who_is_not_let_in_is_told_why() -> None:
    """An address without a rule is not talked to, and tries again; one whose token is no good gives up."""

    async def story() -> None:
        async with relay(settings(rules=())) as server:
            stranger = Session(f"ws://127.0.0.1:{server.port}", "stranger")
            running = asyncio.create_task(stranger.run())
            await until(lambda: stranger.faults)
            assert "HTTP 403" in stranger.faults[0] and "no rule" in stranger.faults[0]
            running.cancel()
        async with relay(settings()) as server:
            await Session(f"ws://127.0.0.1:{server.port}", "stranger", token="x.y.z").run()

    with pytest.raises(RefusedError, match=r"ws://127.0.0.1:\d+: refused: unauthorized: token"):
        asyncio.run(asyncio.wait_for(story(), 30))


@compiled
def test_what_nobody_subscribes_to_is_refused_to_its_sender() -> None:
    async def story() -> None:
        async with relay(settings()) as server:
            sender = Session(f"ws://127.0.0.1:{server.port}", "a")
            task = asyncio.create_task(sender.run())
            try:
                with pytest.raises(BufgymError, match="topic /robots/a/command: refused: no_receiver"):
                    await asyncio.wait_for(sender.command(COMMAND, {"command": "stop"}), 30)
            finally:
                task.cancel()

    asyncio.run(story())


def test_tokens_addresses_and_certificates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("BUFGYM_RELAY_TOKEN", raising=False)
    assert token() is None
    monkeypatch.setenv("BUFGYM_RELAY_TOKEN", "one")
    (tmp_path / "token").write_text("two\n")
    assert token() == "one" and token(tmp_path / "token") == "two"
    with pytest.raises(BufgymError, match="robot:7420: must be ws://HOST:PORT"):
        Session("robot:7420", "a")
    assert security() is None
    with pytest.raises(BufgymError, match="token: no certificate"):
        security(certificate=str(tmp_path / "token"))
    with pytest.raises(BufgymError, match=r"subscription '\[': no regular expression"):
        Session("ws://a:1", "a").subscribe("[", print)
    with pytest.raises(BufgymError, match="topic '/b': this client publishes nothing"):
        Client("ws://a:1", "a").publish("/b", b"")
