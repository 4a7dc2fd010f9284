"""Foxglove's protocol, as Foxglove speaks it: channels are advertised, and their messages come."""

from __future__ import annotations

import asyncio
import json
import struct
from typing import Any

import pytest
from relay_cases import relay, settings
from test_relay_client import compiled, until

pytest.importorskip("foxglove", reason="no foxglove here: the extra foxglove")

from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

from bufgym.relay import ros_messages
from bufgym.relay.foxglove import Bridge
from bufgym.relay.madeup import MadeUp
from bufgym.relay.robot import Robot
from bufgym.relay.session import Session

TOPICS = {"/robots/r/camera", "/robots/r/odom", "/robots/r/queue", "/robots/r/scan", "/robots/r/status", "/tf"}


@compiled
def test_a_client_of_foxglove_sees_the_fleet() -> None:
    channels: dict[str, dict[str, Any]] = {}
    came: dict[str, bytes] = {}

    async def listen(port: int) -> None:
        async with connect(
            f"ws://127.0.0.1:{port}", subprotocols=[Subprotocol("foxglove.sdk.v1")], proxy=None, max_size=None
        ) as socket:
            async for frame in socket:
                if isinstance(frame, str):
                    said = json.loads(frame)
                    if said["op"] == "advertise":
                        new = {one["topic"]: one for one in said["channels"]}
                        wanted = [{"id": one["id"], "channelId": one["id"]} for one in new.values()]
                        await socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
                        channels.update(new)
                elif frame[0] == 1:  # message data: the subscription, the time, the payload
                    number, _ = struct.unpack_from("<IQ", frame, 1)
                    topic = next(one["topic"] for one in channels.values() if one["id"] == number)
                    came[topic] = frame[13:]

    async def story() -> None:
        async with relay(settings(policies=("drop-oldest",))) as server:
            url = f"ws://127.0.0.1:{server.port}"
            bridge = Bridge(Session(url, "foxglove"), port=0)
            robot = Robot(url, "r", MadeUp(), policy="drop-oldest", capacity=16)
            tasks = [asyncio.create_task(work) for work in (bridge.run(), robot.run(), listen(bridge.port))]
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
