"""A robot's recording as a workload: the messages of some topics in one queue, with motion from its odometry for x."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bufgym.errors import BufgymError
from bufgym.traces import bags
from bufgym.traces.files import StrPath
from bufgym.traces.motion import (
    DEFAULT_FOV_DEG,
    DEFAULT_MAX_GAP_S,
    DEFAULT_RATE_HZ,
    DEFAULT_SCENE_SCALE_M,
    motion_from_poses,
)
from bufgym.traces.readers import trace_name
from bufgym.traces.trace import US_PER_S, Int64Array
from bufgym.traces.workload import Workload, read_workload_csv


def read_workload(
    path: StrPath,
    *,
    topics: Sequence[str] | None = None,
    odom: str | None = None,
    fov_deg: float = DEFAULT_FOV_DEG,
    scene_scale_m: float = DEFAULT_SCENE_SCALE_M,
    rate_hz: float = DEFAULT_RATE_HZ,
    max_gap_s: float = DEFAULT_MAX_GAP_S,
    bridge_gaps: bool = False,
) -> Workload:
    """Read a recording of a robot (see `bags.read_bag`) or a workload CSV, told apart by the first bytes.

    Args:
        path: the file or folder.
        topics: names, or patterns such as ``/camera/*``; by default all. They share one queue.
        odom: topic to take motion from, for x (recordings only; see `bags.read_bag`).
        fov_deg, scene_scale_m, rate_hz: see `motion_from_poses`.
        max_gap_s: longer times without a pose are gaps, s.
        bridge_gaps: take motion across a gap as the straight way from its first pose to its last (before the first
            pose and after the last: none); otherwise a gap is an error.

    Raises:
        TraceError: a file that cannot be read, or breaks a rule of its format.
        BufgymError: an unknown topic, no message, or gaps without ``bridge_gaps``.
    """
    if not bags.is_bag(path):
        if odom is not None:
            raise BufgymError(f"{path}: odom = {odom!r}: needs a recording, and this is none")
        return _only(read_workload_csv(path), topics)
    return workload_from_bag(
        bags.read_bag(path, odom),
        topics=topics,
        fov_deg=fov_deg,
        scene_scale_m=scene_scale_m,
        rate_hz=rate_hz,
        max_gap_s=max_gap_s,
        bridge_gaps=bridge_gaps,
    )


def workload_from_bag(
    bag: bags.Bag,
    *,
    topics: Sequence[str] | None = None,
    fov_deg: float = DEFAULT_FOV_DEG,
    scene_scale_m: float = DEFAULT_SCENE_SCALE_M,
    rate_hz: float = DEFAULT_RATE_HZ,
    max_gap_s: float = DEFAULT_MAX_GAP_S,
    bridge_gaps: bool = False,
) -> Workload:
    """The messages of these topics, with x from the bag's poses where it was read with some. See `read_workload`."""
    names = bags.matching(bag.path, list(bag.topics), topics)
    numbers = [list(bag.topics).index(name) for name in names]
    wanted = np.isin(bag.topic, numbers)
    if not wanted.any():
        raise BufgymError(f"{bag.path}: no message on {', '.join(names) or 'any topic'}")
    time_ns = bag.time_ns[wanted]
    x = None
    gaps: tuple[tuple[int, int], ...] = ()
    if bag.poses is not None:
        poses = bag.poses
        motion = motion_from_poses(
            poses.time_us,
            poses.position_m,
            poses.quaternion,
            fov_deg=fov_deg,
            scene_scale_m=scene_scale_m,
            rate_hz=rate_hz,
            max_gap_s=max_gap_s,
        )
        on_motion_us = (time_ns - bag.poses_from_ns) // 1000
        gaps = _gaps(on_motion_us, poses.time_us, max_gap_s)
        if gaps and not bridge_gaps:
            start, end = max(gaps, key=lambda gap: gap[1] - gap[0])
            count = f"{len(gaps)} gaps" if len(gaps) > 1 else "a gap"
            what = f"{count} of more than {max_gap_s:g} s without a pose, the longest {(end - start) / US_PER_S:.1f} s"
            told = "say --bridge-gaps (bridge_gaps=True) to take motion across as even, or choose other odometry"
            raise BufgymError(f"{bag.path}: {poses.format} has {what}, at {start / US_PER_S:.1f} s: {told}")
        # Before the first pose and after the last nothing is known to move: np.interp holds its ends.
        x = np.interp(on_motion_us, motion.time_us, motion.coordinate)
        x -= x[0]
    arrival_us = (time_ns - time_ns[0]) // 1000
    motion_of = f", motion from {bag.poses.format}: {fov_deg:g} degrees, {scene_scale_m:g} m" if bag.poses else ""
    return Workload(
        trace_name(str(bag.path).removesuffix(".mcap").removesuffix(".bag").removesuffix(".db3")),
        arrival_us,
        bag.size_bytes[wanted],
        _renumbered(bag.topic[wanted], numbers, len(bag.topics)),
        tuple(names),
        x,
        f"{bag.path} ({bag.kind}{motion_of})",
        gaps,
    )


def _gaps(arrival_us: Int64Array, pose_us: Int64Array, max_gap_s: float) -> tuple[tuple[int, int], ...]:
    """Stretches of the recording, from its first message to its last, without a pose; in us from the first message."""
    first, last = int(arrival_us[0]), int(arrival_us[-1])
    inside = pose_us[(pose_us > first) & (pose_us < last)]
    # Motion before the first message is of no concern, but the last pose before it tells where it begins.
    before = first if pose_us[0] > first else int(pose_us[pose_us <= first][-1])
    after = last if pose_us[-1] < last else int(pose_us[pose_us >= last][0])
    edges = np.concatenate([[before], inside, [after]])
    long = np.flatnonzero(np.diff(edges) > max_gap_s * US_PER_S)
    return tuple((int(edges[k]) - first, int(edges[k + 1]) - first) for k in long)


def _only(workload: Workload, patterns: Sequence[str] | None) -> Workload:
    """The workload with these topics alone; its clock and its x begin with their first message."""
    if patterns is None:
        return workload
    assert workload.topic is not None
    names = bags.matching(workload.source, workload.topics, patterns)
    numbers = [workload.topics.index(name) for name in names]
    kept = np.isin(workload.topic, numbers)
    arrival_us = workload.arrival_us[kept]
    return replace(
        workload,
        arrival_us=arrival_us - arrival_us[0],
        size_bytes=workload.size_bytes[kept],
        topic=_renumbered(workload.topic[kept], numbers, len(workload.topics)),
        topics=tuple(names),
        x=None if workload.x is None else workload.x[kept] - workload.x[kept][0],
    )


def _renumbered(topic: Int64Array, numbers: Sequence[int], count: int) -> Int64Array:
    """Topics by their place in ``numbers``, int64[n]."""
    place = np.zeros(count, np.int64)
    place[list(numbers)] = np.arange(len(numbers))
    return np.asarray(place[topic], dtype=np.int64)
