"""Trackers side by side on the same frames: ours, OpenCV's and small_gicp's, at every n-th frame of a recording.

    pip install small_gicp
    python examples/trackers.py [--recording FOLDER] [--frames 600] [--every 1 2 4 6 8 10]

All follow the rule of `bufgym_papers.perception.track`: a tracker is lost at the first step that is more than
10 cm or 5 degrees off, or that it refuses. FOLDER is any that `open_sequence` reads; by default the made-up room.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import cv2
import numpy as np
import small_gicp

from bufgym_papers.perception import (
    Sequence,
    Tracker,
    difference,
    grid_of,
    jumped,
    made_up_room,
    open_sequence,
    points_of,
)

WIDTH = 160
Follow = Callable[[np.ndarray], "np.ndarray | None"]
"""Depth of the next frame -> its pose, camera to world; None if lost."""


def ours(sequence: Sequence, depth: np.ndarray, pose: np.ndarray) -> Follow:
    """Track frame to model on a voxel grid."""
    tracker = Tracker(sequence.camera, grid_of(sequence))
    tracker.add(depth, pose)
    return tracker.follow


def opencv(sequence: Sequence, depth: np.ndarray, pose: np.ndarray) -> Follow:
    """Track with cv2.Odometry, frame to frame, by depth alone."""
    camera = sequence.camera
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]], np.float32))
    odometry = cv2.Odometry(cv2.OdometryType_DEPTH, settings, cv2.OdometryAlgoType_COMMON)
    state = {"depth": with_gaps(depth), "pose": pose}

    def follow(depth: np.ndarray) -> np.ndarray | None:
        found, step = odometry.compute(with_gaps(depth), state["depth"])
        if not found:
            return None
        state["depth"], state["pose"] = with_gaps(depth), state["pose"] @ step
        return state["pose"]

    return follow


def with_gaps(depth: np.ndarray) -> np.ndarray:
    """Replace unmeasured depths by NaN, as OpenCV expects."""
    return np.where(depth > 0, depth, np.nan).astype(np.float32)


def gicp(sequence: Sequence, depth: np.ndarray, pose: np.ndarray) -> Follow:
    """Track with small_gicp's generalised ICP, frame to frame, on points thinned to 5 cm."""

    def prepared(depth: np.ndarray) -> tuple[small_gicp.PointCloud, small_gicp.KdTree]:
        return small_gicp.preprocess_points(points_of(depth, sequence.camera), 0.05, num_neighbors=10)

    state = {"cloud": prepared(depth), "pose": pose}

    def follow(depth: np.ndarray) -> np.ndarray | None:
        now = prepared(depth)
        result = small_gicp.align(
            state["cloud"][0], now[0], state["cloud"][1], max_correspondence_distance=0.2, registration_type="GICP"
        )
        if not result.converged:
            return None
        state["cloud"], state["pose"] = now, state["pose"] @ result.T_target_source
        return state["pose"]

    return follow


TRACKERS = {"bufgym": ours, "cv2.Odometry": opencv, "small_gicp": gicp}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recording", help="a folder; by default the made-up room")
    parser.add_argument("--frames", type=int, default=600, help="the first so many")
    parser.add_argument("--every", type=int, nargs="+", default=[1, 2, 4, 6, 8, 10], help="keep every n-th")
    options = parser.parse_args()
    whole = open_sequence(options.recording) if options.recording else made_up_room(0)
    sequence = whole.first(options.frames).reduced(whole.camera.width // WIDTH).loaded()
    count = len(sequence)
    print(f"{whole.name}, {count} frames; frames followed before it is lost (of), drift at the end, ms a frame")
    for every in options.every:
        for name, start in TRACKERS.items():
            print(f"every {every:2d}  {name:13s}", row(sequence, list(range(0, count, every)), start))


def row(sequence: Sequence, frames: list[int], start: Callable[..., Follow]) -> str:
    """One tracker's line."""
    before, true_before = sequence.poses[frames[0]], sequence.poses[frames[0]]
    follow = start(sequence, sequence.depth(frames[0]), before)
    done, took_s, drift_m = 1, 0.0, 0.0
    for k in frames[1:]:
        began = time.process_time()
        pose = follow(sequence.depth(k))
        took_s += time.process_time() - began
        if pose is None:
            break
        truth = sequence.poses[k]
        if jumped(before, pose, true_before, truth):
            break
        before, true_before, done = pose, truth, done + 1
        drift_m = difference(pose, truth)[0]
    return f"{done:4d} of {len(frames):4d}  {100 * drift_m:5.1f} cm  {1000 * took_s / max(1, done):5.1f} ms"


if __name__ == "__main__":
    main()
