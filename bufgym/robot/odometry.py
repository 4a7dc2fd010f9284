"""x on board: the scene's motion, summed from a robot's odometry as it arrives.

For the same poses the sum equals the one by ``bufgym.traces.motion_from_poses`` over a recording.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from bufgym.traces import MotionSettings
from bufgym.traces.poses import angles

_NORM = 0.9, 1.1  # norms of a valid quaternion; some drivers send zeros at first


class Odometry:
    """Call it with each pose; ``x`` is the sum so far."""

    def __init__(self, settings: MotionSettings | None = None) -> None:
        self.settings = settings or MotionSettings()
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

    def take(self, message: Any) -> None:
        """Take an Odometry, PoseStamped or PoseWithCovarianceStamped of ROS 1 or 2."""
        stamp, pose = message.header.stamp, message.pose
        while hasattr(pose, "pose"):
            pose = pose.pose
        time_s = stamp.to_sec() if hasattr(stamp, "to_sec") else stamp.sec + stamp.nanosec / 1e9
        place, turn = pose.position, pose.orientation
        self(time_s, (place.x, place.y, place.z), (turn.x, turn.y, turn.z, turn.w))
