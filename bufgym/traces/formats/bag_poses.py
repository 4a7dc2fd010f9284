"""Poses from the messages of one topic of a recording: odometry, poses, satellite fixes, or a chain of tf."""

import itertools
import math
import re
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from bufgym.traces.formats.definitions import TF_TYPES, check_definition, check_form
from bufgym.traces.formats.definitions import BagTopic as BagTopic
from bufgym.traces.formats.definitions import typestore as typestore
from bufgym.traces.formats.faults import LeftOut, StrPath, fault
from bufgym.traces.formats.geodesy import local_plane
from bufgym.traces.formats.trajectories import MAX_POSITION_M, MOST_OF_FIX, NORM_TOLERANCE
from bufgym.traces.poses import Poses, product, rotations, unit
from bufgym.traces.trace import Float64Array, Int64Array
from bufgym.utils.errors import BufgymError

ODOMETRY: Final = "nav_msgs/msg/Odometry"
_POSE_TYPES: Final = (
    ODOMETRY,
    *(f"geometry_msgs/msg/{name}" for name in ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped")),
)
NAV_SAT_FIX: Final = "sensor_msgs/msg/NavSatFix"
TF_STATIC: Final = "/tf_static"
# Names of topics on which a pose is where a robot shall go, or what a person says. The page's frames.js has them too.
_GOAL: Final = re.compile(
    r"(^|[/_])(goals?|targets?|(way|set)_?points?|clicked|desired|cmd|command|(goal|target|set|initial)_?pose)"
    r"([^a-z/][^/]*)?(/(pose|local|global))?$"
)
_PUBLISHER: Final = re.compile(r"([^:@]+)@([0-9]{1,4})(|:.*)")
# Robots have dozens of transforms; an error message lists no more than these.
_LISTED_FRAMES: Final = 8
_CHAIN: Final = 2  # Frames of a transform, or of a chain of them: the first and the last
_VALUES: Final = 7  # Position and quaternion
_MOST: Final = {False: (MAX_POSITION_M,) * 3, True: tuple(MOST_OF_FIX.values())}  # of a place, of a fix

Frames = tuple[str, str]
"""The frame in which a pose is, and the frame whose pose it is (empty where the message does not say)."""


def carries_poses(topic: str, type: str) -> bool:
    """Whether the messages of this topic say where a robot is; a goal does not."""
    return type in TF_TYPES or type == ODOMETRY or (type in _POSE_TYPES and not is_goal(topic))


def carries_motion(topic: str, type: str) -> bool:
    """Whether the messages of this topic say how a robot moved: poses, or fixes of a satellite receiver."""
    return type == NAV_SAT_FIX or carries_poses(topic, type)


def is_goal(topic: str) -> bool:
    """Whether a topic's name, such as ``/goal_pose`` or ``/initialpose``, says that its poses are no places."""
    return _GOAL.search(topic.lower()) is not None


def named_source(spec: str) -> tuple[str, tuple[str, ...]]:
    """Split ``TOPIC``, ``TOPIC:FRAME`` or ``TOPIC:PARENT:CHILD`` into the topic and its frames."""
    topic, *frames = spec.split(":")
    if len(frames) > 2:
        raise BufgymError(f"odom = {spec!r}: must be a topic, TOPIC:FRAME, or TOPIC:PARENT:CHILD for a transform of tf")
    if is_goal(topic):
        raise BufgymError(f"odom = {spec!r}: {topic} is a goal, no place where the robot is: name its odometry")
    return topic, tuple(name.lstrip("/") for name in frames)


def placed(message: Any) -> Iterator[tuple[Any, Frames, Any, Any]]:
    """Header, frames, position and orientation of each pose in a message of ROS 1 or 2."""
    for stamped in getattr(message, "transforms", ()):
        pose = stamped.transform
        yield stamped.header, _frames(stamped), pose.translation, pose.rotation
    if hasattr(message, "transform"):
        yield message.header, _frames(message), message.transform.translation, message.transform.rotation
    if hasattr(message, "pose"):
        pose = message.pose
        while hasattr(pose, "pose"):
            pose = pose.pose
        yield message.header, _frames(message), pose.position, pose.orientation


def _frames(stamped: Any) -> Frames:
    return stamped.header.frame_id.lstrip("/"), getattr(stamped, "child_frame_id", "").lstrip("/")


class PoseCollector:
    """Decodes the messages of one topic and keeps their poses."""

    def __init__(self, path: StrPath, spec: str) -> None:
        """Take the recording, for error messages, and what ``named_source`` splits, the topic also as ``TOPIC@2``.

        The number after ``@`` chooses one of several publishers of the topic, in order of their first messages.
        """
        self.path, self._spec = path, spec
        match = _PUBLISHER.fullmatch(spec)
        self._publisher = int(match[2]) if match else None
        self.topic, self._frames = named_source(match[1] + match[3] if match else spec)
        self._checked: set[BagTopic] = set()
        self._count = 0
        self._file: Path | None = None
        self._numbers: dict[int, int] = {}  # of a channel in this file -> publisher, from 1 in order of first messages
        self._publishers: dict[int, str] = {}  # their names
        self._poses: dict[tuple[Frames, int], tuple[array[int], array[float]]] = {}  # times in ns, seven values each
        self._static: dict[Frames, list[float]] = {}
        self._is_fix = False

    def wants(self, topic: str) -> bool:
        """Whether the messages of this topic are to be added."""
        return topic == self.topic or (topic == TF_STATIC and len(self._frames) == _CHAIN)

    def add(self, file: Path, channel: BagTopic, time_ns: int, data: bytes) -> None:
        """Keep the poses of a message in this file that was logged at `time_ns`."""
        if channel.topic != self.topic:
            if channel.type in TF_TYPES:
                for frames, values in _values(self._decoded(channel, data)):
                    self._static[frames] = self._sound(TF_STATIC, values)
            return
        self._count += 1
        if file != self._file:
            self._file, self._numbers = file, {}
        number = self._numbers.setdefault(channel.number, len(self._numbers) + 1)
        self._publishers.setdefault(number, channel.publisher)
        if self._publisher not in (None, number):
            return
        message = self._decoded(channel, data)
        self._is_fix = channel.type == NAV_SAT_FIX
        for frames, values in _fixes(message) if self._is_fix else _values(message):
            times_ns, kept = self._poses.setdefault((frames, number), (array("q"), array("d")))
            kept.extend(self._sound(f"{self.topic}, {'fix' if self._is_fix else 'pose'} {len(times_ns) + 1}", values))
            times_ns.append(time_ns)

    def poses(self, topics: dict[str, str]) -> tuple[int, Poses]:
        """Time of the first (ns), and the poses with times from there; of poses at the same time the last counts."""
        if self.topic not in topics:
            raise BufgymError(f"{self.path}: no topic {self.topic!r}; it has: {', '.join(topics) or 'none'}")
        known = sorted({frames for frames, _ in self._poses})
        fitting = [frames for frames in known if frames[: len(self._frames)] == self._frames]
        chain = self._chain() if not fitting and len(self._frames) == _CHAIN else []
        if len(fitting) != 1 and not chain:
            names = [f"{self.topic}:{':'.join(filter(None, frames))}" for frames in known]
            more = f" and {len(names) - _LISTED_FRAMES} more" if len(names) > _LISTED_FRAMES else ""
            chains = " (or of a chain, from its first frame to its last)" if len({*sum(known, ())}) > _CHAIN else ""
            what = (
                "has no pose" if not names else f"say which frames: {', '.join(names[:_LISTED_FRAMES])}{more}{chains}"
            )
            raise BufgymError(f"{self.path}: odom = {self._spec!r}: {what}")
        times_ns, values = self._joined(chain) if chain else self._of_one_publisher(fitting[0])
        if self._is_fix:
            values[:, :3] = local_plane(values[:, :3])
        from_ns = int(times_ns[0])
        time_us = (times_ns - from_ns) // 1000
        left_out = LeftOut()
        left_out.add(time_us, np.arange(1, len(time_us) + 1))
        last = np.append(time_us[1:] != time_us[:-1], True)  # two within a microsecond are one
        if np.count_nonzero(last) < 2:
            count = f", {len(time_us)} poses of one time" if len(time_us) > 1 else ""
            raise BufgymError(f"{self.path}: odom = {self.topic!r} has 1 pose{count}: needs at least 2")
        note = left_out.said(self.path, f"poses on {self.topic}", "pose")
        positions, quaternions = values[last, :3], unit(values[last, 3:])
        about = ", positions of a satellite receiver, no orientation" if self._is_fix else ""
        about = f", {' -> '.join([chain[0][0], *(child for _, child in chain)])}" if chain else about
        return from_ns, Poses(time_us[last], positions, quaternions, f"{self.topic}{about}{note}", from_ns // 1000)

    def _chain(self) -> list[Frames]:
        """The transforms from the first frame asked for down to the second; empty if they are not connected."""
        above = {child: parent for parent, child in [*self._static, *(frames for frames, _ in self._poses)]}
        chain, (top, frame) = list[Frames](), self._frames
        while frame != top and frame in above and len(chain) <= len(above):
            chain.insert(0, (above[frame], frame))
            frame = above[frame]
        moving = any(frames in chain for frames, _ in self._poses)
        return chain if frame == top and moving else []

    def _joined(self, chain: list[Frames]) -> tuple[Int64Array, Float64Array]:
        """Poses of a chain of transforms when its most frequent one was sent, the others interpolated to then.

        Before its first and after its last a rarer one is held, as a map's correction is by its users.
        """
        static = [frames for frames in chain if frames in self._static and (frames, 1) not in self._poses]
        moving = {frames: self._of_one_publisher(frames) for frames in chain if frames not in static}
        times_ns = max((times_ns for times_ns, _ in moving.values()), key=len)
        place, turn = np.zeros((len(times_ns), 3)), np.tile([0.0, 0.0, 0.0, 1.0], (len(times_ns), 1))
        for frames in chain:
            if frames in moving:
                values = _at(*moving[frames], times_ns)
            else:
                values = np.tile(self._static[frames], (len(times_ns), 1))
            place += np.einsum("nij,nj->ni", rotations(turn), values[:, :3])
            turn = product(turn, unit(values[:, 3:]))
        return times_ns, np.hstack([place, turn])

    def _of_one_publisher(self, frames: Frames) -> tuple[Int64Array, Float64Array]:
        """Times in ns and values of the poses in these frames, in order of time.

        Publishers that follow each other, as when a node was started again, count as one.
        """
        by_number = {number: poses for (other, number), poses in self._poses.items() if other == frames}
        spans = sorted((min(times_ns), max(times_ns)) for times_ns, _ in by_number.values())
        if any(begin <= end for (_, end), (begin, _) in itertools.pairwise(spans)):
            names = self._publishers
            listed = [
                f"{self.topic}@{number} ({len(poses[0]):,} poses{names[number] and f' by {names[number]}'})"
                for number, poses in sorted(by_number.items())
            ]
            more = f" and {len(listed) - _LISTED_FRAMES} more" if len(listed) > _LISTED_FRAMES else ""
            what = f"{len(listed)} publishers send at once: say which: {', '.join(listed[:_LISTED_FRAMES])}{more}"
            raise BufgymError(f"{self.path}: odom = {self._spec!r}: {what}")
        times_ns = np.concatenate([np.array(times_ns, np.int64) for times_ns, _ in by_number.values()])
        values = np.concatenate([np.array(values).reshape(-1, _VALUES) for _, values in by_number.values()])
        order = np.argsort(times_ns, kind="stable")
        return times_ns[order], values[order]

    def _decoded(self, channel: BagTopic, data: bytes) -> Any:
        if not carries_motion(channel.topic, channel.type):
            rule = f"must be one of {', '.join((*_POSE_TYPES, *TF_TYPES, NAV_SAT_FIX))}"
            raise BufgymError(f"{self.path}: {self.topic} carries {channel.type or 'no known type'}: {rule}")
        if channel.encoding not in ("cdr", "ros1"):
            raise BufgymError(f"{self.path}: {self.topic} is encoded in {channel.encoding!r}: must be cdr or ros1")
        if channel not in self._checked:
            check_definition(self.path, channel)
            self._checked.add(channel)
        if channel.encoding == "cdr":
            check_form(self.path, f"message {self._count} on {self.topic}", data)
        store = typestore(channel.encoding)
        decode = store.deserialize_cdr if channel.encoding == "cdr" else store.deserialize_ros1
        try:
            return decode(data, channel.type)
        except Exception as error:
            words = " ".join(str(error).split())[:160] or "no more data"
            rule = f"cut off or damaged, or of another definition than {channel.type} has in ROS"
            raise fault(self.path, f"message {self._count} on {self.topic} is {rule}: {words}") from error

    def _sound(self, field: str, values: list[float]) -> list[float]:
        # Written so that NaN fails.
        if not all(abs(value) <= most for value, most in zip(values, _MOST[self._is_fix], strict=False)):
            rule = f"must be finite and within {MAX_POSITION_M:g} m"
            if self._is_fix:
                rule = "must be latitude, longitude and altitude: within 90 and 180 degrees, and 100 km"
            raise fault(self.path, rule, value=tuple(values[:3]), field=field + ", position" * (not self._is_fix))
        norm = math.hypot(*values[3:])
        if not abs(norm - 1) <= NORM_TOLERANCE:
            raise fault(self.path, "must be 1 within 1 %", value=f"{norm:.6g}", field=f"{field}, norm")
        return values


def _values(message: Any) -> Iterator[tuple[Frames, list[float]]]:
    """Frames, position and orientation of each pose in a message."""
    for _, frames, place, turn in placed(message):
        yield frames, [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]


def _fixes(fix: Any) -> Iterator[tuple[Frames, list[float]]]:
    """The same with latitude, longitude and altitude for now; none where the receiver says that it has none."""
    if fix.status.status >= 0 and not math.isnan(fix.latitude + fix.longitude):
        altitude = 0.0 if math.isnan(fix.altitude) else fix.altitude
        yield _frames(fix), [fix.latitude, fix.longitude, altitude, 0.0, 0.0, 0.0, 1.0]


def _at(own_ns: Int64Array, values: Float64Array, times_ns: Int64Array) -> Float64Array:
    """Poses interpolated to these times; the first and the last are held."""
    is_last = np.append(own_ns[1:] != own_ns[:-1], True)
    own_ns, values = own_ns[is_last], values[is_last]
    if len(own_ns) == 1:
        return np.repeat(values, len(times_ns), axis=0)
    at = Poses(own_ns, values[:, :3], unit(values[:, 3:])).at(np.clip(times_ns, own_ns[0], own_ns[-1]))
    return np.hstack([at.position_m, at.quaternion])
