"""Messages of the kinds that the page draws, in ROS 2's encoding, and a made-up robot that publishes them."""

import asyncio
import io
import json
from collections.abc import Iterator
from typing import Any

import numpy as np
from loop_cases import until
from PIL import Image
from pose_cases import ODOMETRY, POSE, TF, message
from relay_cases import Client

from bufgym.traces.formats.bag_poses import typestore

STORE = typestore("cdr")
DIAGNOSTICS, GRID, PATH = "diagnostic_msgs/msg/DiagnosticArray", "nav_msgs/msg/OccupancyGrid", "nav_msgs/msg/Path"
POSES, MARKERS = "geometry_msgs/msg/PoseArray", "visualization_msgs/msg/MarkerArray"
BOOL, BATTERY = "std_msgs/msg/Bool", "sensor_msgs/msg/BatteryState"
ZEROS = {"float": 0.0, "string": "", "bool": False}


def made(type: str, /, **fields: Any) -> Any:
    """An object of a type of ROS; fields that are not given are zero, and quaternions turn nothing."""
    if type == "geometry_msgs/msg/Quaternion":
        fields.setdefault("w", 1.0)
    for name, (kind, what) in STORE.fielddefs[type][1]:
        if name in fields:
            continue
        if kind.name == "BASE":
            fields[name] = next((zero for start, zero in ZEROS.items() if what[0].startswith(start)), 0)
        elif kind.name == "NAME":
            fields[name] = made(what)
        else:
            item, size = what[0], what[1] if kind.name == "ARRAY" else 0
            fields[name] = np.zeros(size, item[1][0]) if item[0].name == "BASE" and item[1][0] != "string" else []
    return STORE.types[type](**fields)


def cdr(type: str, /, **fields: Any) -> bytes:
    return bytes(STORE.serialize_cdr(made(type, **fields), type))


def pose(x: float, y: float) -> Any:
    return made("geometry_msgs/msg/Pose", position=made("geometry_msgs/msg/Point", x=x, y=y))


def header(frame: str) -> Any:
    return made("std_msgs/msg/Header", frame_id=frame)


def marker(shape: int, space: str, number: int, x: float, y: float, **fields: Any) -> Any:
    colour = made("std_msgs/msg/ColorRGBA", r=1.0, g=0.5, b=0.0, a=1.0)
    scale = made("geometry_msgs/msg/Vector3", x=0.3, y=0.3, z=0.3)
    where = {"header": header("map"), "pose": pose(x, y), "scale": scale, "color": colour}
    return made("visualization_msgs/msg/Marker", ns=space, id=number, type=shape, **where, **fields)


def jpeg(colour: tuple[int, int, int], size: tuple[int, int] = (160, 120)) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", size, colour).save(file, "JPEG")
    return file.getvalue()


def drawn() -> Iterator[tuple[str, str, bytes]]:
    """(topic, type, payload): map -> odom is 4 m along x; the plan and a point cloud's box lie in odom."""
    yield "tf", TF, message(TF, 0, 4.0, "map", "odom")
    yield "tf", TF, message(TF, 0, 1.0, "odom", "base_link")
    cells = np.full((40, 60), -1, np.int8)
    cells[2:38, 2:58] = 0
    cells[[2, 37]], cells[:, [2, 57]] = 100, 100
    info = made("nav_msgs/msg/MapMetaData", resolution=0.2, width=60, height=40, origin=pose(-1.0, -4.0))
    yield "map", GRID, cdr(GRID, header=header("map"), info=info, data=cells.ravel())
    steps = [made(POSE, pose=pose(0.5 * k + 1, 0.02 * k * k)) for k in range(10)]
    yield "plan", PATH, cdr(PATH, header=header("odom"), poses=steps)
    cloud = [pose(5 + 0.1 * (k % 5), -0.2 + 0.1 * (k // 5)) for k in range(20)]
    yield "particles", POSES, cdr(POSES, header=header("map"), poses=cloud)
    yield "goal_pose", POSE, cdr(POSE, header=header("map"), pose=pose(9.5, 1.6))
    corner = [made("geometry_msgs/msg/Point", x=x, y=y) for x, y in ((0, 0), (1, 0), (1, 1))]
    shapes = [marker(2, "people", 1, 2.0, 2.0), marker(4, "zones", 2, 1.0, -3.0, points=corner)]
    shapes += [marker(8, "zones", 3, 7.0, -3.0, points=corner), marker(9, "people", 4, 2.0, 2.5, text="Ada")]
    yield "markers", MARKERS, cdr(MARKERS, markers=shapes)


def health(level: int, says: str) -> tuple[str, str, bytes]:
    value = made("diagnostic_msgs/msg/KeyValue", key="current", value="12 A")
    parts = [("laser", 0, "fine"), ("motor left", level, says)]
    array = [
        made("diagnostic_msgs/msg/DiagnosticStatus", name=n, level=k, message=m, values=[value]) for n, k, m in parts
    ]
    return "diagnostics", DIAGNOSTICS, cdr(DIAGNOSTICS, status=array)


class MadeUp:
    """A made-up robot at a relay; it publishes what ``says`` and ``topics`` hold, and lists the commands that came."""

    def __init__(self, to: Client, name: str) -> None:
        self.to, self.name = to, name
        self.says: dict[str, Any] = {}
        self.topics: list[tuple[str, str, bytes]] = []
        self.came: list[Any] = []

    async def publish(self, **said: Any) -> None:
        """Once: its status, and each of its topics."""
        self.says |= said
        kinds = {topic: {"type": type, "encoding": "cdr" if type else "jpeg"} for topic, type, _ in self.topics}
        status = json.dumps({"publishes": kinds, **self.says}).encode()
        await self.to.put(f"/robots/{self.name}/status", status, encoding="json")
        for topic, type, payload in self.topics:
            await self.to.put(f"/robots/{self.name}/{topic}", payload, type=type, encoding="cdr" if type else "jpeg")


__all__ = ["ODOMETRY", "asyncio", "until"]
