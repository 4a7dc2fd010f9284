"""x on board: the scene's motion, summed from a robot's odometry as it arrives.

For the same poses the sum equals the one by ``bufgym.traces.motion_from_poses`` over a recording.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from bufgym.traces import MotionSettings
from bufgym.traces.formats.bag_poses import Frames, named_source, placed
from bufgym.traces.poses import angles
from bufgym.utils.errors import BufgymError

_NORM = 0.9, 1.1  # norms of a valid quaternion; some drivers send zeros at first


class Odometry:
    """Call it with each pose; ``x`` is the sum so far."""

    def __init__(self, settings: MotionSettings | None = None, frames: Sequence[str] = ()) -> None:
        """``frames`` are those that ``take`` follows: a pose's frame, and of tf also the frame whose pose it is."""
        self.settings = settings or MotionSettings()
        self.frames: Frames | None = None
        """Frames of the poses taken: those of the first that fits. Poses in other frames are ignored."""
        self._wanted = tuple(frames)
        self.x = 0.0
        """Motion so far in fields of view; it starts at 0 and never falls."""
        self._last: tuple[float, Any, Any] | None = None

    def __call__(self, time_s: float, position_m: Sequence[float], quaternion: Sequence[float]) -> None:
        """Take a pose; ignore an invalid one, and one that comes sooner than the settings' rate allows.

        Args:
            time_s: its time; if it falls (a restarted simulation), the sum goes on from this pose.
            position_m: three numbers.
            quaternion: four, in any order that stays the same.
        """
        position, turn = np.asarray(position_m, np.float64), np.asarray([quaternion], np.float64)
        norm = float(np.linalg.norm(turn))
        if not (_NORM[0] < norm < _NORM[1] and np.isfinite(position).all() and math.isfinite(time_s)):
            return
        turn /= norm
        if self._last is not None and time_s >= self._last[0]:
            # Odometry at this very rate jitters by some percent.
            if time_s - self._last[0] < 0.9 / self.settings.rate_hz:
                return
            turned_rad = float(angles(self._last[2], turn)[0])
            moved_m = float(np.linalg.norm(position - self._last[1]))
            self.x += turned_rad / math.radians(self.settings.fov_deg) + moved_m / self.settings.scene_scale_m
        self._last = time_s, position, turn

    def take(self, message: Any) -> tuple[Any, Any] | None:
        """Take an Odometry, PoseStamped, PoseWithCovarianceStamped or TFMessage of ROS 1 or 2.

        Returns: position and orientation; None if the message has no pose in the frames that are followed.
        """
        found = None
        for header, frames, place, turn in placed(message):
            if self.frames is None and frames[: len(self._wanted)] == self._wanted:
                self.frames = frames
            if frames == self.frames:
                stamp = header.stamp
                time_s = stamp.to_sec() if hasattr(stamp, "to_sec") else stamp.sec + stamp.nanosec / 1e9
                self(time_s, (place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))
                found = place, turn
        return found


def followed(spec: str, settings: MotionSettings | None = None) -> tuple[str, Odometry]:
    """The topic of ``TOPIC``, ``TOPIC:FRAME`` or ``TOPIC:PARENT:CHILD``, and the sum over its poses in these frames."""
    topic, frames = named_source(spec)
    if topic.endswith(("tf", "tf_static")) and len(frames) < 2:
        raise BufgymError(f"odom = {spec!r}: say which transform, as {topic}:odom:base_link")
    return topic, Odometry(settings, frames)
