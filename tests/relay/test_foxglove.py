"""Foxglove's protocol, as Foxglove speaks it: channels are advertised, and their messages come."""

from __future__ import annotations

import asyncio
import json
import struct
from pathlib import Path
from typing import Any

import pytest
from relay_cases import ALL, client, relay, run, settings
from test_relay_client import compiled, until

pytest.importorskip("foxglove", reason="no foxglove here: the extra foxglove")

from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

from bufgym.errors import BufgymError
from bufgym.relay import ros_messages
from bufgym.relay.config import Foxglove, Rule, load
from bufgym.relay.foxglove import Bridge, Screen
from bufgym.relay.madeup import MadeUp
from bufgym.relay.robot import Robot
from bufgym.relay.server import Server
from bufgym.relay.session import Session
from bufgym.relay.wire import MAX_STAMP_US, Message

TOPICS = {"/robots/r/camera", "/robots/r/odom", "/robots/r/queue", "/robots/r/scan", "/robots/r/status", "/tf"}


class Viewer:
    """A client of Foxglove's protocol that wants all there is."""

    def __init__(self) -> None:
        self.channels: dict[str, dict[str, Any]] = {}
        self.came: dict[str, bytes] = {}

    async def listen(self, address: str) -> None:
        async with connect(
            f"ws://{address}", subprotocols=[Subprotocol("foxglove.sdk.v1")], proxy=None, max_size=None
        ) as socket:
            async for frame in socket:
                if isinstance(frame, str):
                    said = json.loads(frame)
                    if said["op"] == "advertise":
                        new = {one["topic"]: one for one in said["channels"]}
                        wanted = [{"id": one["id"], "channelId": one["id"]} for one in new.values()]
                        await socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
                        self.channels.update(new)
                elif frame[0] == 1:  # message data: the subscription, the time, the payload
                    number, _ = struct.unpack_from("<IQ", frame, 1)
                    topic = next(one["topic"] for one in self.channels.values() if one["id"] == number)
                    self.came[topic] = frame[13:]


@compiled
def test_a_client_of_foxglove_sees_the_fleet() -> None:
    viewer = Viewer()
    channels, came = viewer.channels, viewer.came

    async def story() -> None:
        async with relay(settings(policies=("drop-oldest",))) as server:
            url = f"ws://127.0.0.1:{server.port}"
            bridge = Bridge(Session(url, "foxglove"), port=0)
            robot = Robot(url, "r", MadeUp(), policy="drop-oldest", capacity=16)
            tasks = [asyncio.create_task(work) for work in (bridge.run(), robot.run(), viewer.listen(bridge.address))]
            try:
                await until(lambda: set(came) == TOPICS)
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)

    asyncio.run(story())
    scan = channels["/robots/r/scan"]
    assert (scan["encoding"], scan["schemaName"], scan["schemaEncoding"]) == ("cdr", ros_messages.SCAN, "ros2msg")
    assert "float32[] ranges" in scan["schema"]
    assert ros_messages.read(came["/robots/r/scan"], ros_messages.SCAN).header.frame_id == "r/base"
    assert channels["/robots/r/camera"]["schemaName"] == "foxglove.CompressedImage"
    assert channels["/tf"]["schemaName"] == "foxglove.FrameTransform" and b"r/base" in came["/tf"]
    assert 0 < json.loads(came["/robots/r/status"])["battery"] <= 1


# --- the relay's own ------------------------------------------------------------------------------------------------


def test_a_relay_shows_what_its_rules_allow() -> None:
    """Of what a robot sends, who connects to the relay's own server sees what rules with ``foxglove`` let it see."""
    viewer = Viewer()
    rules = (ALL, Rule(foxglove=True, receive=True, topic="/robots/[^/]+/(scan|odom|text|camera|stop)"))

    async def story() -> None:
        config = settings(rules=rules, foxglove=Foxglove(port=0), no_drop=("/robots/[^/]+/stop",))
        async with relay(config) as server, client(server.port) as robot, client(server.port) as other:
            assert server.window is not None
            listening = asyncio.create_task(viewer.listen(server.window.address))
            await other.subscribe("stop$")
            seq = 0
            while set(viewer.came) != {f"/robots/r/{name}" for name in ("odom", "camera", "text", "stop")}:
                seq += 1
                assert seq < 400, viewer.came
                await robot.put("/robots/r/private", b"secret")
                # What says that it is a pose and is none, and a time that no clock of Foxglove's has, stop nothing.
                await robot.put("/robots/r/odom", b"12", encoding="cdr", type=ros_messages.ODOMETRY)
                await robot.put("/robots/r/camera", b"jpeg", encoding="jpeg", stamp_us=MAX_STAMP_US)
                await robot.put("/robots/r/text", b"hello")
                await robot.put("/robots/r/stop", b"1", encoding="json", seq=seq, no_drop=True)
                await asyncio.sleep(0.05)
            listening.cancel()
            await asyncio.gather(listening, return_exceptions=True)
            assert server.hub.status()["refused"] == 0

    run(story)
    assert viewer.came["/robots/r/text"] == b"hello" and viewer.channels["/robots/r/text"]["encoding"] == "raw"


def test_without_a_rule_it_shows_nothing() -> None:
    viewer = Viewer()

    async def story() -> None:
        async with relay(settings(foxglove=Foxglove(port=0))) as server, client(server.port) as robot:
            assert server.window is not None
            listening = asyncio.create_task(viewer.listen(server.window.address))
            for _ in range(10):
                await robot.put("/robots/r/text", b"hello")
                await asyncio.sleep(0.02)
            listening.cancel()
            await asyncio.gather(listening, return_exceptions=True)

    run(story)
    assert viewer.channels == {}


def test_strangers_cannot_fill_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bufgym.relay.foxglove.MAX_CHANNELS", 3)
    screen = Screen("127.0.0.1", 0)
    for k in range(9):
        screen.show(Message("/a", b"1", "raw", f"type-{k}"))
    screen.close()
    assert len(screen._channels) == 3


def test_its_table_and_its_port(tmp_path: Path) -> None:
    path = tmp_path / "relay.toml"
    path.write_text("[foxglove]\nport = 9000\n[[rules]]\nfoxglove = true\nreceive = true\n")
    config = load(path)
    assert config.foxglove == Foxglove(port=9000) and config.rules == (Rule(foxglove=True, receive=True),)
    screen = Screen("127.0.0.1", 0)
    taken = int(screen.address.rpartition(":")[2])
    with pytest.raises(BufgymError, match=rf"127\.0\.0\.1:{taken}: Foxglove's server: "):
        asyncio.run(Server(settings(foxglove=Foxglove(port=taken))).start())
    screen.close()
