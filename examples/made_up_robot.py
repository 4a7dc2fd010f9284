"""A made-up robot that drives through a made-up room, with odometry, a laser, a camera and a battery.

Walls are straight and upright, so a ray in the plane says all: how far, on which wall, where along it. Run
``python examples/made_up_robot.py [ws://HOST:PORT]`` for one robot at a relay; ``fleet_demo.py`` has several.
"""

import asyncio
import io
import math
import sys
import time
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rosbags.typesys import Stores, get_typestore

from bufgym import BufgymError
from bufgym.scenario import Stream, read_client
from bufgym_robot import Robot

Floats = NDArray[np.float64]

# --- the room --------------------------------------------------------------------------------------------------------

HALF_M: Final = (6.0, 4.0)
"""The room reaches so far from its middle, along x and y."""
WALL_M: Final = 2.4
EYE_M: Final = 0.9
"""Height of the walls, and of the camera."""
PICTURE: Final = (256, 192)
FIELD_OF_VIEW: Final = math.radians(75)
_BOXES: Final = (  # x, y, width, depth, colour
    (0.0, 0.0, 12.0, 8.0, (214, 206, 190)),  # the room itself
    (0.0, 0.0, 2.8, 1.2, (176, 96, 64)),
    (-5.2, 2.9, 1.2, 1.6, (72, 118, 168)),
    (5.3, -2.8, 1.0, 1.8, (88, 148, 96)),
    (-5.0, -3.4, 1.6, 0.8, (196, 160, 72)),
    (4.6, 3.5, 2.2, 0.7, (148, 92, 148)),
    (0.0, 3.75, 3.0, 0.5, (150, 150, 158)),
)


def _walls() -> tuple[Floats, Floats, Floats]:
    """(where each wall begins [n, 2], where it leads [n, 2], its colour [n, 3])."""
    begins, leads, colours = [], [], []
    for x, y, width, depth, colour in _BOXES:
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (width / 2, depth / 2) + (x, y)
        for k in range(4):
            begins.append(corners[k])
            leads.append(corners[(k + 1) % 4] - corners[k])
            colours.append(np.array(colour) * (1.0 if k % 2 else 0.8))  # light comes from one side
    return np.array(begins), np.array(leads), np.array(colours)


_BEGINS, _LEADS, _COLOURS = _walls()


class Pose(NamedTuple):
    """Where a robot stands, m, and where it looks, rad."""

    x: float
    y: float
    yaw: float


def pose_at(number: int, time_s: float) -> Pose:
    """Robot ``number`` drives round the table in the middle, on a loop of its own; odd ones the other way."""
    loop_x, loop_y = 3.0 + 0.45 * (number % 3), 1.75 + 0.3 * (number % 3)
    way = 1 if number % 2 == 0 else -1
    angle = way * time_s * (0.22 + 0.02 * (number % 4)) + 2.1 * number
    x, y = loop_x * math.cos(angle), loop_y * math.sin(angle)
    return Pose(x, y, math.atan2(way * loop_y * math.cos(angle), -way * loop_x * math.sin(angle)))


def cast(pose: Pose, angles: Floats) -> tuple[Floats, NDArray[np.int64], Floats]:
    """(distance in m, number of the wall, m along it) for a ray at each of ``angles``, from where the robot looks."""
    ahead = np.stack([np.cos(angles + pose.yaw), np.sin(angles + pose.yaw)], -1)[:, None]
    away = _BEGINS - (pose.x, pose.y)
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray along a wall meets it nowhere
        slant = _cross(ahead, _LEADS)
        distance = _cross(away, _LEADS) / slant
        along = _cross(away, ahead) / slant
        meets = (distance > 1e-6) & (along >= 0) & (along <= 1)
    distance = np.where(meets, distance, np.inf)
    wall = distance.argmin(1)
    rays = np.arange(len(angles))
    return distance[rays, wall], wall, along[rays, wall] * np.hypot(*_LEADS[wall].T)


def _cross(one: Any, other: Any) -> Any:
    return one[..., 0] * other[..., 1] - one[..., 1] * other[..., 0]


_FOCAL: Final = PICTURE[0] / 2 / math.tan(FIELD_OF_VIEW / 2)
_ANGLES: Final = np.arctan((PICTURE[0] / 2 - 0.5 - np.arange(PICTURE[0])) / _FOCAL)
_BELOW: Final = ((np.arange(PICTURE[1]) + 0.5 - PICTURE[1] / 2) / _FOCAL).astype(np.float32)[:, None]
"""Of a row's point 1 m ahead, m under the eye."""
_HALF: Final = PICTURE[1] // 2
_REACH: Final = EYE_M / _BELOW[_HALF:]
"""How far ahead the floor is in each row of the lower half, m."""
_CEILING: Final = (236 - 60 * np.exp(_BELOW[:_HALF] * 4)).astype(np.uint8)[..., None]
_TILES: Final = (np.array([96, 122]) / (1 + 0.06 * _REACH))[..., None] * np.array([1.05, 1.0, 0.92])
"""Colours of the floor's dark and light tiles in each row."""


def picture(pose: Pose) -> NDArray[np.uint8]:
    """What the camera sees, [height, width, 3]."""
    distance, wall, along = cast(pose, _ANGLES)
    depth = (distance * np.cos(_ANGLES)).astype(np.float32)
    # Panels of half a metre, darker with distance.
    panel = 1 - 0.12 * (np.floor(along * 2) % 2) - 0.25 * (np.abs(along * 2 % 1 - 0.5) > 0.47)
    shade = (_COLOURS[wall] * (panel / (1 + 0.11 * depth))[:, None]).astype(np.uint8)
    frame = np.empty((PICTURE[1], PICTURE[0], 3), np.uint8)
    frame[:] = shade
    down = _BELOW * depth
    upper, lower = frame[:_HALF], frame[_HALF:]
    np.copyto(upper, _CEILING, where=(down[:_HALF] < EYE_M - WALL_M)[..., None])
    np.copyto(lower, (shade * 0.55).astype(np.uint8), where=(down[_HALF:] > EYE_M - 0.12)[..., None])  # skirting
    turn = _ANGLES + pose.yaw
    aside, ahead = ((f(turn) / np.cos(_ANGLES)).astype(np.float32) for f in (np.sin, np.cos))
    tile = np.floor(pose.x + _REACH * ahead).astype(np.int32) + np.floor(pose.y + _REACH * aside).astype(np.int32)
    floor = _TILES.astype(np.uint8)[np.arange(_HALF)[:, None], tile & 1]
    np.copyto(lower, floor, where=(down[_HALF:] > EYE_M)[..., None])
    return frame


def jpeg(frame: NDArray[np.uint8], quality: int = 70) -> bytes:
    """The picture as a JPEG file."""
    file = io.BytesIO()
    Image.fromarray(frame).save(file, "JPEG", quality=quality)
    return file.getvalue()


# --- messages of ROS 2 in CDR ----------------------------------------------------------------------------------------

TYPES: Final = get_typestore(Stores.ROS2_JAZZY)
ODOMETRY: Final = "nav_msgs/msg/Odometry"
SCAN: Final = "sensor_msgs/msg/LaserScan"


def _header(time_us: int, frame: str) -> Any:
    kinds = TYPES.types
    stamp = kinds["builtin_interfaces/msg/Time"](time_us // 10**6, time_us % 10**6 * 1000)
    return kinds["std_msgs/msg/Header"](stamp, frame)


def odometry(time_us: int, robot: str, pose: Pose, speed_m_s: float) -> bytes:
    """Make a ``nav_msgs/msg/Odometry``."""
    kinds, zeros = TYPES.types, np.zeros(36)
    vector = kinds["geometry_msgs/msg/Vector3"]
    turn = kinds["geometry_msgs/msg/Quaternion"](0.0, 0.0, math.sin(pose.yaw / 2), math.cos(pose.yaw / 2))
    place = kinds["geometry_msgs/msg/Pose"](kinds["geometry_msgs/msg/Point"](pose.x, pose.y, 0.0), turn)
    motion = kinds["geometry_msgs/msg/Twist"](vector(speed_m_s, 0.0, 0.0), vector(0.0, 0.0, 0.0))
    message = kinds[ODOMETRY](
        _header(time_us, "map"),
        f"{robot}/base",
        kinds["geometry_msgs/msg/PoseWithCovariance"](place, zeros),
        kinds["geometry_msgs/msg/TwistWithCovariance"](motion, zeros),
    )
    return bytes(TYPES.serialize_cdr(message, ODOMETRY))


def scan(time_us: int, robot: str, angles: NDArray[np.float64], ranges_m: NDArray[np.float64]) -> bytes:
    """Make a ``sensor_msgs/msg/LaserScan`` of these equally spaced angles."""
    step = float(angles[1] - angles[0])
    ends = float(angles[0]), float(angles[-1])
    ranges, intensities = ranges_m.astype(np.float32), np.zeros(0, np.float32)
    message = TYPES.types[SCAN](
        _header(time_us, f"{robot}/base"), *ends, step, 0.0, 0.1, 0.05, 30.0, ranges, intensities
    )
    return bytes(TYPES.serialize_cdr(message, SCAN))


# --- the robot -------------------------------------------------------------------------------------------------------

CONFIG: Final = Path(__file__).with_name("made_up_robot.toml")
"""Configuration of its topics, in the format of a client's."""
BEAMS: Final = np.radians(np.arange(-180, 180, 2.0))
_DRAIN_S: Final = 3600.0
"""Time for a full battery to run empty."""
_TURN_S: Final = 0.05
SPEED_M_S: Final = 0.6
"""Speed on the way to a goal, and back to the loop."""


class MadeUp:
    """The ``number``-th made-up robot, a source for a ``Robot``: its topics are ``odom``, ``scan`` and ``camera``."""

    def __init__(self, number: int = 0, streams: tuple[Stream, ...] | None = None) -> None:
        self.number = number
        self.streams = read_client(CONFIG).streams if streams is None else streams
        self._began_s = self._moved_s = time.monotonic()
        self._loop_s = 0.0
        """How long it has been on its loop; it does not count while it stands or drives elsewhere."""
        self._at, self._stands = pose_at(number, 0.0), False
        self._goal: Pose | None = None
        self._driven = (0.0, 0.0)
        """Velocity at which a person drives it: m/s ahead, rad/s to the left."""

    async def run(self, robot: Robot) -> None:
        makers = {"odom": self._odometry, "scan": self._scan, "camera": self._camera}
        due_s = {stream.topic.name: self._began_s for stream in self.streams if stream.topic.name in makers}
        period_s = {stream.topic.name: 1 / stream.rate_hz for stream in self.streams}
        while True:
            now_s = time.monotonic()
            for name in due_s:
                if due_s[name] <= now_s:
                    due_s[name] = max(due_s[name] + period_s[name], now_s - _TURN_S)
                    makers[name](robot)
            await asyncio.sleep(max(0.0, min(due_s.values()) - time.monotonic()))

    def _odometry(self, robot: Robot) -> None:
        before, before_s = self._at, self._moved_s
        pose = self._move()
        speed_m_s = math.hypot(pose.x - before.x, pose.y - before.y) / max(1e-3, self._moved_s - before_s)
        robot.publish("odom", odometry(self._now()[1], robot.name, pose, speed_m_s), "cdr", ODOMETRY)

    def _scan(self, robot: Robot) -> None:
        ranges_m = cast(self._move(), BEAMS)[0]
        robot.publish("scan", scan(self._now()[1], robot.name, BEAMS, ranges_m), "cdr", SCAN)

    def _camera(self, robot: Robot) -> None:
        robot.publish("camera", jpeg(picture(self._move())), "jpeg")

    def _now(self) -> tuple[float, int]:
        """Return the time in s since it began and in us since 1970."""
        return time.monotonic() - self._began_s, time.time_ns() // 1000

    def _move(self) -> Pose:
        """Drive on, as far as time has passed, and return where it is."""
        now_s = time.monotonic()
        passed_s, self._moved_s = now_s - self._moved_s, now_s
        target = self._goal or pose_at(self.number, self._loop_s + passed_s)
        dx, dy = target.x - self._at.x, target.y - self._at.y
        gap, step = math.hypot(dx, dy), SPEED_M_S * passed_s
        if any(self._driven):
            ahead_m, yaw = self._driven[0] * passed_s, self._at.yaw + self._driven[1] * passed_s
            place = self._at.x + ahead_m * math.cos(yaw), self._at.y + ahead_m * math.sin(yaw)
            x, y = (max(-half, min(half, one)) for one, half in zip(place, HALF_M, strict=True))
            self._at = Pose(x, y, yaw)
        if self._stands:
            return self._at
        if self._goal is None and gap <= 2 * step + 0.2:
            self._loop_s, self._at = self._loop_s + passed_s, target
        elif gap <= step:
            self._at = target
        else:
            self._at = Pose(self._at.x + dx * step / gap, self._at.y + dy * step / gap, math.atan2(dy, dx))
        return self._at

    def status(self) -> dict[str, Any]:
        charge = 1 - 0.13 * (self.number % 5) - self._now()[0] / _DRAIN_S
        text = "stands" if self._stands else "drives to its goal" if self._goal else "drives round"
        commands = ["stop", "goal", "cancel", "drive"]
        return {"battery": round(max(0.0, charge), 3), "ok": True, "text": text, "commands": commands}

    async def on_command(self, command: Any) -> None:
        """Obey ``stop``, ``goal`` (drive straight to x, y), ``cancel`` (go on round the table) or ``drive``."""
        self._move()
        self._driven = (0.0, 0.0)
        match command:
            case {"command": "stop"}:
                self._stands = True
            case {"command": "cancel"}:
                self._stands, self._goal = False, None
            case {
                "command": "goal",
                "x": float() | int() as x,
                "y": float() | int() as y,
                "yaw": float() | int() as yaw,
            }:
                if not (abs(x) <= HALF_M[0] and abs(y) <= HALF_M[1]):
                    raise BufgymError(f"goal {x}, {y}: must be in the room, {HALF_M} m from its middle")
                self._stands, self._goal = False, Pose(x, y, yaw)
            case {"command": "drive", "linear": float() as linear, "angular": float() as angular}:
                self._stands, self._goal, self._driven = True, None, (linear, angular)
            case _:
                raise BufgymError(f"command {command!r}: must be stop, goal, cancel or drive")


if __name__ == "__main__":
    url = sys.argv[1] if len(sys.argv) > 1 else "ws://127.0.0.1:7420"
    asyncio.run(Robot(url, "robot-1", MadeUp(), say=print).run())
