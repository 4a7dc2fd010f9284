"""Foxglove's protocol, as Foxglove speaks it: channels are advertised, and their messages come."""

import json
import struct
from typing import Any

import pytest
from loop_cases import beside, compiled
from made_up_robot import ODOMETRY, SCAN, MadeUp
from needs import needs
from relay_cases import ALL, Corner, client, relay, settings, until, within

pytest.importorskip("foxglove", reason=needs("extras", "foxglove"))

from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus
from websockets.typing import Subprotocol

from bufgym.utils.errors import BufgymError
from bufgym_relay.config import Foxglove, Rule
from bufgym_relay.foxglove import Bridge, Screen
from bufgym_relay.server import Server
from bufgym_robot.fleet.robot import Robot
from bufgym_robot.wire import ros_messages
from bufgym_robot.wire.messages import MAX_STAMP_US, Message
from bufgym_robot.wire.session import Session

CONFIG = settings(policies=("drop-oldest",))


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
async def test_a_client_of_foxglove_sees_the_fleet(corner: Corner, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bufgym_robot.fleet.robot.STATUS_S", 0.1)
    viewer = Viewer()
    channels, came, robot = viewer.channels, viewer.came, f"/robots/{corner.robot}"
    bridge = Bridge(Session(corner.url, "foxglove"), port=0)
    source = Robot(corner.url, corner.robot, MadeUp(), policy="drop-oldest", capacity=16)
    topics = {f"{robot}/{name}" for name in ("camera", "odom", "queue", "scan", "status")}
    async with beside(bridge.run(), source.run(), viewer.listen(bridge.address)):
        await until("all topics", lambda: set(came) >= {*topics, "/tf"})  # and the relay's own
    scan = channels[f"{robot}/scan"]
    assert (scan["encoding"], scan["schemaName"], scan["schemaEncoding"]) == ("cdr", SCAN, "ros2msg")
    assert "float32[] ranges" in scan["schema"]
    base = f"{corner.robot}/base"
    assert ros_messages.read(came[f"{robot}/scan"], SCAN).header.frame_id == base
    assert channels[f"{robot}/camera"]["schemaName"] == "foxglove.CompressedImage"
    assert channels["/tf"]["schemaName"] == "foxglove.FrameTransform" and base.encode() in came["/tf"]
    assert 0 < json.loads(came[f"{robot}/status"])["battery"] <= 1


async def test_a_relay_shows_what_its_rules_allow() -> None:
    """Of what a robot sends, who connects to the relay's own server sees what rules with ``foxglove`` let it see."""
    viewer = Viewer()
    rules = (ALL, Rule(foxglove=True, receive=True, topic="/robots/[^/]+/(scan|odom|text|camera|halt)"))
    config = settings(rules=rules, foxglove=Foxglove(port=0), no_drop=("/robots/[^/]+/halt",))
    async with relay(config) as server, client(server.port) as robot, client(server.port) as other:
        assert server.window is not None
        await other.subscribe("halt$")
        async with within("what it may see"), beside(viewer.listen(server.window.address)):
            seq = 0
            while set(viewer.came) != {f"/robots/r/{name}" for name in ("odom", "camera", "text", "halt")}:
                seq += 1
                await robot.put("/robots/r/private", b"secret")
                # What says that it is a pose and is none, and a time that no clock of Foxglove's has, stop nothing.
                await robot.put("/robots/r/odom", b"12", encoding="cdr", type=ODOMETRY)
                await robot.put("/robots/r/camera", b"jpeg", encoding="jpeg", stamp_us=MAX_STAMP_US)
                await robot.put("/robots/r/text", b"hello")
                await robot.command(seq, "/robots/r/halt")
                while not any(said.get("op") == "ack" for said in await robot.rest()):
                    pass
                await other.came(seq)
                await other.say("ack", seq=seq)
        assert server.hub.status()["refused"] == 0
    assert viewer.came["/robots/r/text"] == b"hello" and viewer.channels["/robots/r/text"]["encoding"] == "raw"


async def test_without_a_rule_it_shows_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[Message] = []
    monkeypatch.setattr(Screen, "show", lambda screen, message: shown.append(message))
    for rules in ((ALL,), (ALL, Rule(foxglove=True, receive=True))):
        assert not shown
        config = settings(foxglove=Foxglove(port=0), rules=rules)
        async with relay(config) as server, client(server.port) as robot:
            await robot.put("/robots/r/text", b"hello")
            await robot.rest()
    assert [message.topic for message in shown] == ["/robots/r/text"]


async def test_only_pages_that_are_named_get_in() -> None:
    """A program says no origin; a page of any other server is refused."""
    screen = Screen("127.0.0.1", 0, ["https://lichtblick.example.org"])
    url, spoken = f"ws://{screen.address}", [Subprotocol("foxglove.sdk.v1")]
    for origin in (None, "https://app.foxglove.dev", "https://lichtblick.example.org"):
        async with connect(url, subprotocols=spoken, proxy=None, origin=origin) as viewer:
            assert json.loads(await viewer.recv())["op"] == "serverInfo"
    for origin in ("https://evil.example.org", "null", "https://app.foxglove.dev.example.org"):
        with pytest.raises(InvalidStatus, match="HTTP 403"):
            await connect(url, subprotocols=spoken, proxy=None, origin=origin)
    screen.close()
    await until("an end", lambda: not screen._gate._open)


async def test_strangers_cannot_fill_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bufgym_relay.foxglove.MAX_CHANNELS", 3)
    screen = Screen("127.0.0.1", 0)
    for k in range(9):
        screen.show(Message("/a", b"1", "raw", f"type-{k}"))
    screen.close()
    assert len(screen._channels) == 3


async def test_a_port_that_is_taken() -> None:
    screen = Screen("127.0.0.1", 0)
    taken = int(screen.address.rpartition(":")[2])
    with pytest.raises(BufgymError, match=rf"127\.0\.0\.1:{taken}: Foxglove's server: "):
        await Server(settings(foxglove=Foxglove(port=taken))).start()
    screen.close()
