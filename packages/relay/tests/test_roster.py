"""Robots that were here: the relay keeps what they said last over a restart, until somebody removes them."""

import json
import time
from pathlib import Path
from typing import Any

from relay_cases import ALL, client, relay, settings

from bufgym_relay.config import Rule
from bufgym_relay.roster import MOST_ROBOTS, Roster
from bufgym_relay.store import Store
from bufgym_robot.wire.messages import Message

STATUS = {"ok": True, "text": "charges", "battery": 0.5, "location": {"x": 1, "y": 2, "yaw": 0, "frame": "map"}}


async def test_a_robot_is_known_after_a_restart_until_it_is_removed(tmp_path: Path) -> None:
    """It has its place and its words, and the time at which it said them. Who may not remove it, does not."""
    watch = Rule(address="127.0.0.2", receive=True)
    config = settings(folder=tmp_path, rules=(ALL, watch))
    last = "/robots/one/last"
    async with relay(config) as server, client(server.port, name="one") as robot:
        await robot.put("/robots/one/status", json.dumps({**STATUS, "queue": {}}).encode(), encoding="json")
        assert await robot.rest() == []
    async with relay(config) as server:
        async with client(server.port) as viewer:
            await viewer.subscribe("^/robots/[^/]+/last$")
            said = await viewer.next()
            assert (said.topic, said.sender, json.loads(bytes(said.payload))) == (last, "relay", STATUS)
            await viewer.put(last, b"{}", encoding="json")
            (refused,) = await viewer.rest()
            assert refused["why"] == f"topic {last}: only null may be published here, which removes the robot"
            async with client(server.port) as other:
                await other.put(last, b"null", encoding="json")
                assert await other.rest() == []
            gone = await viewer.next()
            assert (gone.topic, bytes(gone.payload)) == (last, b"null")
        removed = [one for one in server.hub.audit.recent if one["event"] == "removed"]
        assert [one["topic"] for one in removed] == [last]
    async with relay(config) as server, client(server.port) as viewer:
        await viewer.subscribe("^/robots/[^/]+/last$")
        assert await viewer.rest() == []


def roster(folder: Path, clock: Any) -> tuple[Roster, list[Message]]:
    """A roster over a store in a folder, and what it publishes."""
    config, published = settings(folder=folder), list[Message]()
    store = Store(config, lambda *_, **__: None, lambda _: None, clock)  # type: ignore[arg-type]
    return Roster(store, published.append, clock, lambda: time.time_ns() // 1000), published


def kept(one: Roster, folder: Path) -> list[Message]:
    """What a relay that starts anew knows, once this one's file is closed."""
    one._store.close()
    again, _ = roster(folder, lambda: 0.0)
    found = list(again.away())
    again._store.close()
    return found


def test_who_is_silent_for_long_is_away(tmp_path: Path) -> None:
    """After 5 s the relay says once what it said last; a status that says nothing readable says nothing."""
    now_s = 0.0
    one, published = roster(tmp_path, lambda: now_s)
    one(Message("/robots/r/status", json.dumps(STATUS).encode()))
    one(Message("/robots/odd/status", b"[1"))
    one(Message("/robots/long/status", json.dumps({"text": "x" * 3000}).encode()))
    one(Message("/robots/r/camera", b"1"))
    now_s = 4.9
    one.tick()
    assert published == []
    now_s = 5.1
    one.tick()
    now_s = 20.0
    one.tick()
    said = {message.topic: json.loads(message.payload) for message in published}
    assert said == {"/robots/r/last": STATUS, "/robots/odd/last": {}, "/robots/long/last": {}} and len(published) == 3
    assert {message.topic for message in kept(one, tmp_path)} == set(said)


def test_robots_do_not_fill_the_store(tmp_path: Path) -> None:
    one, _ = roster(tmp_path, lambda: 0.0)
    for part in range(3):
        for k in range(MOST_ROBOTS // 2):
            one(Message(f"/robots/{part}-{k}/status", b"{}"))
        one.close()
    parts = [message.topic.split("/")[2].partition("-")[0] for message in kept(one, tmp_path)]
    assert len(parts) == MOST_ROBOTS and parts.count("2") == MOST_ROBOTS // 2
