"""Robofleet's released clients, played from its published schema."""

import contextlib
import json
import random
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from issuer_cases import Issuer
from mutations import COUNT, SEED, mutated
from needs import needs
from relay_cases import Server, client, relay, settings, until, wait
from test_identity import ANNA
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, WebSocketException

from bufgym_relay import robofleet
from bufgym_relay.config import Limits
from bufgym_robot.wire.messages import WireError

flatbuffers = pytest.importorskip("flatbuffers", reason=needs("extras", "flatbuffers"))


def flat(type: str, topic: str, *texts: str, action: int | None = None) -> bytes:
    """A message of metadata, texts, and perhaps a number: as RobofleetStatus or RobofleetSubscription begin."""
    builder = flatbuffers.Builder(64)
    strings = [builder.CreateString(text) for text in texts]
    type_at, topic_at = builder.CreateString(type), builder.CreateString(topic)
    builder.StartObject(2)
    builder.PrependUOffsetTRelativeSlot(0, type_at, 0)
    builder.PrependUOffsetTRelativeSlot(1, topic_at, 0)
    metadata = builder.EndObject()
    builder.StartObject(2 + len(texts))
    builder.PrependUOffsetTRelativeSlot(0, metadata, 0)
    for k, string in enumerate(strings):
        builder.PrependUOffsetTRelativeSlot(1 + k, string, 0)
    if action is not None:
        builder.PrependUint8Slot(2, action, 0)
    builder.Finish(builder.EndObject())
    return bytes(builder.Output())


def wants(pattern: str, action: int = 1) -> bytes:
    return flat("amrl_msgs/RobofleetSubscription", "/subscriptions", pattern, action=action)


STATUS = flat("amrl_msgs/RobofleetStatus", "/robot/status", "ok", "hall")


def test_what_the_schema_says_is_read() -> None:
    assert robofleet.read(STATUS) == ("amrl_msgs/RobofleetStatus", "/robot/status", "", False)
    assert robofleet.read(wants("/status$"))[2:] == ("/status$", True)
    assert robofleet.read(wants("/status$", 0))[2:] == ("/status$", False)
    assert robofleet.read(flat("a/B", "name")).topic == "/name"


def test_whole_messages_by_another_writer() -> None:
    """The flatbuffers of Table I, which are made from ROS's definitions."""
    encodings = pytest.importorskip("studies.encodings", reason=needs("extras", "studies.encodings"))
    pytest.importorskip("rosbags", reason=needs("extras", "rosbags"))
    data = encodings.encode("LaserScan", encodings.content("LaserScan"), "robofleet", topic="/robot/scan")
    assert robofleet.read(data)[:2] == ("sensor_msgs/LaserScan", "/robot/scan")


def test_broken_flatbuffers_are_refused() -> None:
    data = [STATUS, wants("^/a$")]
    for k in range(COUNT):
        uniform = random.Random(f"{SEED}-flatbuffer-{k}")
        with contextlib.suppress(WireError):
            assert robofleet.read(mutated(uniform, uniform.choice(data), data)).topic.startswith("/")


@contextlib.asynccontextmanager
async def released(port: int) -> AsyncIterator[ClientConnection]:
    """As the released clients connect: any path, no subprotocol, no hello."""
    async with connect(f"ws://127.0.0.1:{port}/", compression=None, proxy=None, close_timeout=0.2) as socket:
        yield socket


async def wanted(server: Server, patterns: int) -> None:
    """Return once clients have so many subscriptions in all: released ones are not told."""
    members = server.hub.members
    await until("subscriptions", lambda: sum(len(one.subscriptions) for one in members.values()) == patterns)


async def test_released_clients_meet() -> None:
    async with (
        relay(settings(robofleet=True)) as server,
        released(server.port) as robot,
        released(server.port) as page,
        client(server.port, name="ours") as ours,
    ):
        await ours.subscribe("^/robot/")
        await page.send(wants("["))  # is refused, and nobody hurt
        await page.send(wants("/status"))
        await wanted(server, 2)
        await ours.put("/robot/status", b"of another encoding")
        await ours.rest()
        await robot.send(STATUS)
        assert await wait("a flatbuffer", page.recv()) == STATUS
        message = await ours.next()
        assert (message.encoding, message.type) == ("robofleet", "amrl_msgs/RobofleetStatus")
        assert bytes(message.payload) == STATUS
        await ours.put("/robot/status", STATUS, encoding="robofleet")
        assert await wait("a flatbuffer", page.recv()) == STATUS
        await page.send(wants("/status", 0))
        await wanted(server, 1)
        await robot.send(STATUS)
        assert bytes((await ours.next()).payload) == STATUS
        # On a no_drop topic the relay holds it for ours, which acks. (And this comes next to the page, not a status.)
        command = flat("std_msgs/String", "/robots/a/command", "go")
        await ours.subscribe("^/robots/a/command$", id="c")
        await page.send(wants("^/robots/a/command$"))
        await wanted(server, 3)
        await robot.send(command)
        message = await ours.next()
        assert (message.topic, message.seq, message.no_drop) == ("/robots/a/command", 1, True)
        assert await wait("a flatbuffer", page.recv()) == command
        await robot.send(b"garbage")
        with pytest.raises(ConnectionClosed):  # and it has heard nothing
            await wait("the end", robot.recv())


async def test_a_flood_of_requests_is_refused_and_fills_no_log() -> None:
    """Three are taken at a time. Of the four beyond, the log has one line, and another with the count."""
    async with (
        relay(settings(robofleet=True, limits=Limits(messages_per_s=3))) as server,
        released(server.port) as page,
    ):
        server.hub.clock = lambda: 0.0
        for k in range(7):
            await page.send(wants(f"/{k}"))
        await wanted(server, 3)
        await page.send(wants("/2", 0))
        await wanted(server, 2)
        server.hub.audit.flush()
        lines = [entry.get("times") for entry in server.hub.audit.recent if entry.get("code") == "too_fast"]
        assert lines == [None, 3]


async def test_it_is_off_unless_asked_for() -> None:
    async with relay() as server:
        with pytest.raises(WebSocketException):
            async with released(server.port):
                pass


async def test_a_token_lets_a_released_page_in(tmp_path: Path) -> None:
    issuer = Issuer(tmp_path)
    async with (
        relay(settings(robofleet=True, rules=(ANNA,), tokens=issuer.tokens)) as server,
        released(server.port) as page,
        client(server.port, token=issuer.token()) as robot,
    ):
        await page.send(json.dumps({"id_token": issuer.token()}))
        await page.send(wants("status"))
        await wanted(server, 1)
        await robot.put("/robot/status", STATUS, encoding="robofleet")
        assert await wait("a flatbuffer", page.recv()) == STATUS
        async with released(server.port) as nobody:
            await nobody.send(json.dumps({"id_token": issuer.token(exp=1.0)}))
            await wait("the end", nobody.wait_closed())
