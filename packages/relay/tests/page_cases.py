"""Messages of the kinds that the page draws, in ROS 2's encoding, and made-up robots that publish them."""

import asyncio
import functools
import json
import threading
from typing import Any

import numpy as np
import ros_cases
from pose_cases import POSE, TF, message
from relay_cases import ALL, Client, client, relay, settings

from bufgym.traces.formats.bag_poses import typestore
from bufgym_relay.config import Limits
from bufgym_robot.wire.patterns import escaped

STORE = typestore("cdr")
made = functools.partial(ros_cases.made, STORE)
DIAGNOSTICS, GRID, PATH = "diagnostic_msgs/msg/DiagnosticArray", "nav_msgs/msg/OccupancyGrid", "nav_msgs/msg/Path"
POSES, MARKERS = "geometry_msgs/msg/PoseArray", "visualization_msgs/msg/MarkerArray"
CLOUD, CODES = "sensor_msgs/msg/PointCloud2", ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")
Topics = tuple[tuple[str, str, bytes], ...]
"""(topic, type, payload) each; without a type it is a JPEG file."""


def cdr(type: str, /, frame: str = "", **fields: Any) -> bytes:
    """Such an object as bytes, its header in a frame."""
    return bytes(STORE.serialize_cdr(made(type, header=made("std_msgs/msg/Header", frame_id=frame), **fields), type))


def pose(x: float, y: float) -> Any:
    return made("geometry_msgs/msg/Pose", position=made("geometry_msgs/msg/Point", x=x, y=y))


def marker(shape: int, space: str, number: int, at: Any, **fields: Any) -> Any:
    fields["color"] = made("std_msgs/msg/ColorRGBA", r=1.0, g=0.5, b=0.0, a=1.0)
    fields["scale"] = made("geometry_msgs/msg/Vector3", x=0.3, y=0.3, z=0.3)
    head = made("std_msgs/msg/Header", frame_id="map")
    return made("visualization_msgs/msg/Marker", header=head, ns=space, id=number, type=shape, pose=at, **fields)


def drawn() -> Topics:
    """A robot at x = 5 in the map, in which odom lies at x = 4; its plan is said in odom."""
    cells = np.full((40, 60), -1, np.int8)
    cells[2:38, 2:58] = 0
    cells[[2, 37]], cells[:, [2, 57]] = 100, 100
    grid = made("nav_msgs/msg/MapMetaData", resolution=0.2, width=60, height=40, origin=pose(-1.0, -4.0))
    steps = [made(POSE, pose=pose(0.5 * k + 1, 0.02 * k * k)) for k in range(10)]
    cloud = [pose(5 + 0.1 * (k % 5), -0.2 + 0.1 * (k // 5)) for k in range(20)]
    corner = [made("geometry_msgs/msg/Point", x=x, y=y) for x, y in ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))]
    shapes = [marker(2, "people", 1, pose(2.0, 2.0)), marker(9, "people", 2, pose(2.0, 2.5), text="Ada")]
    shapes += [marker(shape, "zones", shape, pose(3.0 * shape - 11, -3.0), points=corner) for shape in (4, 8)]
    return (
        ("tf", TF, message(TF, 0, 4.0, "map", "odom")),
        ("tf", TF, message(TF, 0, 1.0, "odom", "base_link")),
        ("map", GRID, cdr(GRID, "map", info=grid, data=cells.ravel())),
        ("plan", PATH, cdr(PATH, "odom", poses=steps)),
        ("particles", POSES, cdr(POSES, "map", poses=cloud)),
        ("goal_pose", POSE, cdr(POSE, "map", pose=pose(9.5, 1.6))),
        ("markers", MARKERS, bytes(STORE.serialize_cdr(made(MARKERS, markers=shapes), MARKERS))),
    )


def cloud(points: Any, frame: str = "base_link") -> bytes:
    """A PointCloud2 of one row: a structured array, with its names, types, offsets and order of bytes."""
    kinds, (count,), step = points.dtype, points.shape, points.dtype.itemsize
    codes = {name: 1 + CODES.index(kinds[name].str[1:]) for name in kinds.names}
    fields = [
        made("sensor_msgs/msg/PointField", name=name, offset=kinds.fields[name][1], datatype=code, count=1)
        for name, code in codes.items()
    ]
    size = {"height": 1, "width": count, "point_step": step, "row_step": step * count}
    is_big, data = kinds["x"].str[0] == ">", np.frombuffer(points.tobytes(), np.uint8)
    return cdr(CLOUD, frame, fields=fields, is_bigendian=is_big, data=data, **size)


def health(level: int, says: str) -> Topics:
    """Diagnostics of a motor at this level, and of a laser that is fine."""
    parts = [("laser", 0, "fine"), ("motor left", level, says)]
    array = [made("diagnostic_msgs/msg/DiagnosticStatus", name=n, level=k, message=m) for n, k, m in parts]
    return (("diagnostics", DIAGNOSTICS, cdr(DIAGNOSTICS, status=array)),)


class Fleet:
    """A relay with made-up robots, in a thread; each publishes its status and topics some times a second."""

    every_s = 0.1

    def __init__(self, token: str | None = None, **changed: Any) -> None:
        """``changed`` are settings of the relay; ``token`` is the robots'."""
        self.hello: dict[str, Any] = {"name": "fleet"} if token is None else {"name": "fleet", "token": token}
        self.settings = settings(**{"rules": (ALL,), "limits": Limits(hello_s=60), **changed})
        self.robots: dict[str, tuple[dict[str, Any], Topics]] = {}
        self.released: Topics = ()
        """What a robot of Robofleet's publishes: whole topics, types and flatbuffers."""
        self.came: list[Any] = []
        self.driven: list[Any] = []
        self.port, self.over, self.ready = 0, threading.Event(), threading.Event()
        self.thread = threading.Thread(target=lambda: asyncio.run(self.run()))

    def __enter__(self) -> "Fleet":
        self.thread.start()
        assert self.ready.wait(60), "waited 60 s for a relay"
        return self

    def __exit__(self, *error: object) -> None:
        self.over.set()
        self.thread.join(60)
        assert not self.thread.is_alive(), "waited 60 s for a relay's end"

    async def run(self) -> None:
        async with relay(self.settings) as server, client(server.port, **self.hello) as one:
            self.port = server.port
            self.ready.set()
            known = set[str]()
            while not self.over.is_set():
                for name, (status, topics) in list(self.robots.items()):
                    if name not in known:
                        known.add(name)
                        await one.say("subscribe", id=name, topic=f"^/robots/{escaped(name)}/(command|drive)$")
                    await self.publish(one, name, status, topics)
                for topic, type, payload in self.released:
                    await one.put(topic, payload, type=type, encoding="robofleet")
                for said in await one.rest():
                    if isinstance(said, dict):
                        continue
                    command = json.loads(bytes(said.payload))
                    if said.topic.endswith("/drive"):
                        self.driven.append(command)
                        continue
                    await one.say("ack", seq=said.seq)
                    self.came.append(command)
                    answer = {"id": command["id"], "why": "too far" if command.get("x", 0) > 1 else ""}
                    self.robots[said.topic.split("/")[2]][0]["answer"] = answer
                await asyncio.sleep(self.every_s)

    async def publish(self, one: Client, name: str, status: dict[str, Any], topics: Topics) -> None:
        kinds = {topic: {"type": type, "encoding": "cdr" if type else "jpeg"} for topic, type, _ in topics}
        said = json.dumps({"publishes": kinds, **status}).encode()
        await one.put(f"/robots/{name}/status", said, encoding="json")
        for topic, type, payload in topics:
            await one.put(f"/robots/{name}/{topic}", payload, type=type, encoding="cdr" if type else "jpeg")
