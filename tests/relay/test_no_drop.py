"""Messages of which nothing may be lost: exactly once, over reconnects of either side and kills of the relay."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
import sys
from pathlib import Path
from typing import Any

import pytest
from relay_cases import Client, client, in_folder, relay, run, settings
from websockets.exceptions import WebSocketException

from bufgym.live.sockets import free_port
from bufgym.relay.config import Rule, Store
from bufgym.relay.wire import Message

HERE = Path(__file__).parent
KILLS = int(os.environ.get("BUFGYM_KILLS", "3"))


async def came(one: Client, seq: int, payload: bytes) -> None:
    message = await one.next()
    assert (message.seq, bytes(message.payload), message.no_drop) == (seq, payload, True)


def test_acks_end_to_end() -> None:
    """The relay acks what it holds; when all receivers have acked, the sender is told."""

    async def story() -> None:
        async with relay() as server, client(server.port) as operator, client(server.port) as robot:
            await operator.command(1)
            refused = await operator.next()
            assert (refused["code"], refused["seq"]) == ("no_receiver", 1)
            await robot.subscribe("command$")
            await operator.command(1)  # a refused number was not used
            assert await operator.next() == {"op": "ack", "seq": 1}
            await came(robot, 1, b"1")
            assert server.hub.status()["held"] == 1
            await robot.say("ack", seq=1)
            assert await operator.next() == {"op": "delivered", "seq": 1, "receivers": 1, "lost": 0}
            assert server.hub.status()["held"] == 0
            await operator.command(3)
            assert (await operator.next())["code"] == "out_of_order"
            await operator.command(1)  # it was taken: it is acked again, and not sent again
            assert await operator.next() == {"op": "ack", "seq": 1} and await robot.nothing()

    run(story)


def test_no_more_than_the_window_are_on_their_way() -> None:
    async def story() -> None:
        async with (
            relay(settings(store=Store(window=2))) as server,
            client(server.port) as operator,
            client(server.port) as robot,
        ):
            await robot.subscribe("command$")
            for seq in range(1, 5):
                await operator.command(seq)
                assert (await operator.next())["op"] == "ack"
            await came(robot, 1, b"1")
            await came(robot, 2, b"2")
            assert await robot.nothing()
            await robot.say("ack", seq=2)
            await came(robot, 3, b"3")
            await robot.say("ack", seq=9)
            await came(robot, 4, b"4")
            assert "must be at most 4" in (await robot.next())["why"]

    run(story)


def test_held_while_its_receiver_is_away() -> None:
    async def story() -> None:
        async with relay(settings(store=Store(messages=2))) as server, client(server.port) as operator:
            async with client(server.port, session="a") as robot, client(server.port, session="b") as viewer:
                assert (await robot.subscribe("command$", durable=True))["op"] == "subscribed"
                await viewer.subscribe("command$")
            for seq, code in ((1, None), (2, None), (3, "store_full")):
                await operator.command(seq)
                assert (await operator.next()).get("code") == code
            async with client(server.port, session="a") as robot:
                await came(robot, 1, b"1")
                await came(robot, 2, b"2")
            async with client(server.port, session="a", received=1) as robot:
                await came(robot, 2, b"2")
                assert (await operator.next())["op"] == "delivered"
                await robot.say("ack", seq=2)
                assert (await operator.next())["seq"] == 2
                await operator.command(3)
                await came(robot, 3, b"3")
            # It had not asked to be waited for.
            async with client(server.port, session="b") as viewer:
                assert await viewer.nothing()

    run(story)


def test_the_same_session_takes_over() -> None:
    async def story() -> None:
        async with (
            relay() as server,
            client(server.port) as operator,
            client(server.port, session="a") as old,
            client(server.port, session="a") as new,
        ):
            await asyncio.wait_for(old.socket.wait_closed(), 5)
            assert old.socket.close_reason == "taken over by another connection"
            await new.subscribe("command$")
            await operator.command(1)
            await came(new, 1, b"1")

    run(story)


def test_the_name_of_a_session_belongs_to_who_uses_it() -> None:
    """Another identity's session of the same name is another: it neither takes over, nor gets what is held."""
    rules = (Rule(address="127.0.0.0/8", send=True, receive=True),)

    async def story() -> None:
        async with relay(settings(rules=rules)) as server, client(server.port) as operator:
            async with client(server.port, session="a") as robot:
                await robot.subscribe("command$", durable=True)
                async with client(server.port, session="a", local="127.0.0.2") as thief:
                    assert thief.welcome["op"] == "welcome" and await robot.nothing()
            await operator.command(1)
            assert (await operator.next())["op"] == "ack"
            async with client(server.port, session="a", local="127.0.0.2") as thief:
                assert await thief.nothing()
            async with client(server.port, session="a") as robot:
                await came(robot, 1, b"1")

    run(story)


def test_what_a_forgotten_session_had_to_get_is_told() -> None:
    async def story() -> None:
        async with relay(settings(store=Store(keep_s=0.5))) as server, client(server.port) as operator:
            async with client(server.port, session="a") as robot:
                await robot.subscribe("command$", durable=True)
            await operator.command(1)
            assert (await operator.next())["op"] == "ack"
            assert await operator.next() == {"op": "delivered", "seq": 1, "receivers": 1, "lost": 1}
            assert [entry["held"] for entry in server.hub.audit.recent if entry["event"] == "forgotten"] == [1]

    run(story)


def test_a_right_that_was_withdrawn(tmp_path: Path) -> None:
    """What is held for a session that may not receive it any more is not sent, and its sender is told."""

    async def story() -> None:
        async with relay(in_folder(tmp_path)) as server, client(server.port, session="o") as operator:
            async with client(server.port, session="a") as robot:
                await robot.subscribe("command$", durable=True)
            await operator.command(1)
            assert (await operator.next())["op"] == "ack"
        rules = (Rule(address="127.0.0.1", send=True), Rule(address="127.0.0.1", receive=True, topic="/other"))
        async with (
            relay(in_folder(tmp_path, rules=rules)) as server,
            client(server.port, session="o") as operator,
            client(server.port, session="a") as robot,
        ):
            assert operator.welcome["received"] == 1
            assert (await operator.next())["lost"] == 1 and await robot.nothing()
            await operator.command(2)
            assert (await operator.next())["code"] == "no_receiver"

    run(story)


@pytest.mark.parametrize("sender", [True, False])
def test_a_relay_that_lost_its_store_goes_on(sender: bool) -> None:
    async def story() -> None:
        async with (
            relay() as server,
            client(server.port, session="a", acked=41 * sender) as operator,
            client(server.port, session="b", received=7 * (not sender)) as robot,
        ):
            await robot.subscribe("command$")
            await operator.command(41 * sender + 1)
            assert (await operator.next())["op"] == "ack"
            assert (await robot.next()).seq == 7 * (not sender) + 1

    run(story)


# --- the relay is killed ---------------------------------------------------------------------------------------------


class End:
    """A client that connects again and again, in one session."""

    def __init__(self, port: int, session: str) -> None:
        self.port, self.session = port, session
        self.received = self.acked = 0
        self.back_s: list[float] = []

    async def run(self) -> None:
        loop, lost_s = asyncio.get_running_loop(), None
        while True:
            with contextlib.suppress(OSError, WebSocketException, TimeoutError):
                hello = {"session": self.session, "received": self.received, "acked": self.acked}
                async with client(self.port, **hello) as one:
                    if lost_s is not None:
                        self.back_s.append(loop.time() - lost_s)
                    lost_s = None
                    await self.talk(one)
            lost_s = lost_s or loop.time()
            await asyncio.sleep(0.05)

    async def talk(self, one: Client) -> None:
        raise NotImplementedError


class Sender(End):
    """Five commands unanswered at most, numbered from 1."""

    async def talk(self, one: Client) -> None:
        self.acked = sent = one.welcome["received"]
        while True:
            while sent < self.acked + 5:
                sent += 1
                await one.command(sent)
            said = await one.next()
            if said["op"] == "ack":
                self.acked = max(self.acked, said["seq"])
            elif said["op"] == "refused":
                assert said["code"] in ("no_receiver", "store_full", "out_of_order"), said
                sent = self.acked
                await asyncio.sleep(0.01)


class Receiver(End):
    def __init__(self, port: int, session: str) -> None:
        super().__init__(port, session)
        self.took: list[int] = []

    async def talk(self, one: Client) -> None:
        await one.say("subscribe", id="c", topic="command$", durable=True)
        while True:
            message = await one.next()
            if isinstance(message, Message) and message.seq > self.received:
                self.received = message.seq
                self.took.append(int(bytes(message.payload)))
                await one.say("ack", seq=message.seq)


async def started(port: int, folder: Path) -> Any:
    program = [sys.executable, str(HERE / "relay_process.py"), str(port), str(folder)]
    process = await asyncio.create_subprocess_exec(*program, stdout=asyncio.subprocess.PIPE)
    assert process.stdout is not None
    assert b"http" in await asyncio.wait_for(process.stdout.readline(), 60)
    return process


def test_exactly_once_though_the_relay_is_killed(tmp_path: Path) -> None:
    """Under load, without warning, again and again."""

    async def story() -> None:
        port, uniform = free_port("127.0.0.1"), random.Random(0)
        receiver = Receiver(port, "robot")
        senders = [Sender(port, f"operator-{k}") for k in range(2)]
        process = await started(port, tmp_path)
        tasks = [asyncio.create_task(receiver.run())]
        await asyncio.sleep(0.3)
        tasks += [asyncio.create_task(sender.run()) for sender in senders]
        try:
            for _ in range(KILLS):
                await asyncio.sleep(uniform.uniform(0.2, 0.8))
                process.send_signal(signal.SIGKILL)
                await process.wait()
                process = await started(port, tmp_path)
            taken = len(receiver.took)
            while len(receiver.took) < taken + 100:
                await asyncio.sleep(0.05)
                assert not any(task.done() for task in tasks)
            for task in tasks[1:]:
                task.cancel()
            # What was acked to the senders arrives, and the rest of what they sent may.
            while len(receiver.took) < sum(sender.acked for sender in senders):
                await asyncio.sleep(0.05)
        finally:
            for task in tasks:
                task.cancel()
            process.kill()
            await process.wait()
        for k in range(1, max(receiver.took) + 1):
            times = sum(k <= sender.acked for sender in senders)
            assert times <= receiver.took.count(k) <= len(senders), k
        print(f"{len(receiver.took)} commands, {KILLS} kills, back in {[round(s, 2) for s in receiver.back_s]} s")
        assert len(receiver.back_s) >= KILLS

    run(story, 60 + 10 * KILLS)
