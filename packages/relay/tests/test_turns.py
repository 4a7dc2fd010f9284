"""Nobody keeps the others waiting: long turns of the event loop are logged, and recordings are read one at a time."""

import asyncio
import contextlib
import inspect
import json
import resource
import threading
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from loop_cases import beside
from relay_cases import client, relay, settings, until

from bufgym_relay import caller, outbox, replay, server, turns
from bufgym_relay.connection import Connection
from bufgym_relay.hub import MOST_IN_TURN
from bufgym_relay.outgoing import Outgoing
from bufgym_relay.subscriber import Subscription
from bufgym_robot.wire import messages as wire


async def test_who_takes_a_long_turn_is_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Messages of one client take 30 ms each, and those of another 10: the limit is 20."""
    now_s = 0.0
    monkeypatch.setattr(turns, "clock", lambda: now_s)
    async with relay(settings()) as server, client(server.port, local="127.0.0.2") as slow, client(server.port) as one:
        publish = server.hub.publish

        def publishing(sender: Any, message: Any) -> None:
            nonlocal now_s
            now_s += {"/slow": 0.03, "/quick": 0.01}.get(message.topic, 0.0)
            publish(sender, message)

        monkeypatch.setattr(server.hub, "publish", publishing)
        for topic, sender in (("/slow", slow), ("/quick", one)):
            for _ in range(3):
                await sender.put(topic)
                await sender.rest()
        server.hub.tick()
        found = [entry for entry in server.hub.audit.recent if entry["event"] == "slow"]
        assert {entry["who"] for entry in found} == {"127.0.0.2"}
        assert sum(entry["times"] for entry in found) == 3 and found[0]["longest_ms"] == 30.0


class Others:
    """All others, who count their turns."""

    turn = 0

    async def run(self) -> None:
        while True:
            self.turn += 1
            await asyncio.sleep(0)


async def test_large_messages_are_written_in_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """A picture of 100 kB goes to five viewers: all others have a turn between any two."""
    others, wrote = Others(), list[int]()
    async with relay(settings()) as server, contextlib.AsyncExitStack() as stack, client(server.port) as one:
        for _ in range(5):
            viewer = await stack.enter_async_context(client(server.port))
            await viewer.subscribe("^/picture$")
        write = outbox.Outbox._write_queued

        def writing(box: Any, *words: Any) -> Any:
            lane = write(box, *words)
            wrote.extend([others.turn] * (lane is not None))
            return lane

        monkeypatch.setattr(outbox.Outbox, "_write_queued", writing)
        async with beside(others.run()):
            await one.put("/picture", bytes(100_000))
            await until("all to have it", lambda: len(wrote) == 5)
        assert len(set(wrote)) == 5


async def test_what_comes_together_is_taken_in_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sixty messages have come at once; all others have a turn after eight of them."""
    others, taken = Others(), list[int]()
    async with relay(settings()) as server, client(server.port) as one:
        monkeypatch.setattr(
            server.hub, "publish", lambda sender, message: taken.append(others.turn) if sender else None
        )
        frame = wire.encode(wire.Message("/a", b"1", "raw"))
        (accepted,) = server._admission.open
        async with beside(others.run()):
            accepted.data_received(60 * (bytes([0x82, 0x80 | len(frame), 0, 0, 0, 0]) + frame))
            await until("all", lambda: len(taken) == 60)
    assert max(map(taken.count, taken)) == 8 and one.welcome["op"] == "welcome"


async def test_what_is_latched_is_offered_in_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    """All others have a turn after 256 topics; one that gets a newer message meanwhile comes once, with that."""
    others, came = Others(), list[tuple[int, str, bytes]]()

    def offer(connection: Connection, subscription: Subscription, outgoing: Outgoing) -> None:
        message = outgoing.message
        came.append((others.turn, message.topic, bytes(message.payload)))
        if len(came) == 1:
            one.hub.publish(None, wire.Message("/map/999", b"new", "raw"))

    async with relay(settings(latched=("/map/.*",))) as one, client(one.port) as viewer:
        monkeypatch.setattr(Connection, "offer", offer)
        for k in range(1_000):
            one.hub.publish(None, wire.Message(f"/map/{k}", b"old", "raw"))
        async with beside(others.run()):
            await viewer.subscribe("^/map/")
            await until("all", lambda: len(came) == 1_000)
    turns_taken = [turn for turn, _, _ in came]
    assert max(map(turns_taken.count, turns_taken)) <= MOST_IN_TURN + 1
    assert [payload for _, topic, payload in came if topic == "/map/999"] == [b"new"]


def test_it_takes_no_more_connections_than_files(monkeypatch: pytest.MonkeyPatch) -> None:
    said, given = list[str](), list[tuple[int, int]]()
    monkeypatch.setattr(resource, "setrlimit", lambda _, both: given.append(both))
    for most, connections in ((100_000, 4_096), (1_024, 960), (10, 1), (resource.RLIM_INFINITY, 4_096)):
        monkeypatch.setattr(resource, "getrlimit", lambda _, most=most: (256, most))
        assert server._fitted(settings(), said.append).limits.all_connections == connections
        assert given.pop() == (most, most)
    assert len(said) == 2 and "all_connections is 960, not 4096: ulimit -Hn is 1024" in said[0]


async def test_a_task_is_the_same_under_the_watch() -> None:
    """It gets what it waits for, and the errors that are thrown into it; it returns and raises, or never begins."""

    async def works(error: Exception | None) -> str:
        if error is not None:
            raise error
        return "done"

    watch = turns.Turns()
    assert await watch.of("a", partial(works, None)) == "done"
    with pytest.raises(ValueError, match="no"):
        await watch.of("a", partial(works, ValueError("no")))

    async def forever() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            ended.append(True)

    ended = list[bool]()
    async with beside(watch.of("a", forever)):
        await asyncio.sleep(0)
    async with beside(watch.of("a", forever)):
        pass
    assert ended == [True]


async def test_recordings_are_read_one_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of six clients that ask at once; messages go on meanwhile."""
    go, reading, most = threading.Event(), 0, 0

    def piece(*asked: Any) -> dict[str, Any]:
        nonlocal reading, most
        reading += 1
        most = max(most, reading)
        assert go.wait(60.0)
        reading -= 1
        return {"messages": [{"topic": "/a"}], "next_us": None, "first_us": 0, "last_us": 0}

    monkeypatch.setattr(replay, "piece", piece)
    async with relay(settings(folder=tmp_path)) as server, contextlib.AsyncExitStack() as stack:
        clients = [await stack.enter_async_context(client(server.port)) for _ in range(6)]
        for one in clients:
            await one.say("replay", id="r", file="x", from_us=0, most_bytes=1)
        viewer = await stack.enter_async_context(client(server.port, local="127.0.0.2"))
        await viewer.subscribe("^/a$")
        robot = await stack.enter_async_context(client(server.port, local="127.0.0.3"))
        await robot.put("/a")
        assert (await viewer.next()).topic == "/a"
        await until("a reader", lambda: reading)
        go.set()
        for one in clients:
            said = await one.next()
            assert (said["op"], said["id"], said["messages"], said["last_us"]) == (
                "replayed",
                "r",
                [{"topic": "/a"}],
                0,
            )
        assert most == 1


async def test_a_long_answer_is_written_as_its_reader_takes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 8 MB at most one piece waits in the relay. Others' messages go on, and the answer is whole in the end."""
    text = json.dumps({"op": "replayed", "id": "r", "messages": [{"data": "x" * 1_000_000}] * 8})
    monkeypatch.setattr(replay, "answer_text", lambda *asked: text)
    async with (
        relay(settings(folder=tmp_path)) as server,
        client(server.port, receive_buffer_bytes=65_536) as one,
        client(server.port, local="127.0.0.2") as viewer,
        client(server.port, local="127.0.0.3") as robot,
    ):
        one.socket.protocol.max_message_size = None
        port = one.socket.local_address[1]
        (accepted,) = [each for each in server._admission.open if each.remote_address[1] == port]
        await viewer.subscribe("^/a$")
        await one.say("replay", id="r", file="x", from_us=0, most_bytes=1)
        await until("a piece that waits", accepted.transport.get_write_buffer_size)
        for _ in range(3):
            await robot.put("/a")
            assert (await viewer.next()).topic == "/a"
            assert accepted.transport.get_write_buffer_size() < caller.PIECE + 20
        parts = [str(part) async for part in one.socket.recv_streaming()]
        assert "".join(parts) == text and max(map(len, parts)) == caller.PIECE


async def test_others_have_a_turn_between_two_pieces() -> None:
    had = 0

    async def other() -> None:
        nonlocal had
        while True:
            had += 1
            await asyncio.sleep(0)

    async with beside(other()):
        async for _ in caller._pieces("x" * 10 * caller.PIECE):
            before, had = had, 0
    assert before == 1


async def test_work_in_turns_is_a_coroutine_that_a_task_takes() -> None:
    """Python 3.12 and later take nothing else, and the relay would serve nobody."""

    async def work() -> int:
        await asyncio.sleep(0)
        return 7

    made = turns.Turns().of("a", work)
    assert inspect.iscoroutine(made)
    assert await asyncio.create_task(made) == 7
