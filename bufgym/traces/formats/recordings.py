"""A robot's recording as a workload: the messages of some topics in one queue, with x from its odometry."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np
import numpy.typing as npt

from bufgym.traces import plausible
from bufgym.traces.formats import bags
from bufgym.traces.formats.faults import StrPath, heard, warn
from bufgym.traces.formats.links import trace_name
from bufgym.traces.formats.splits import is_recording
from bufgym.traces.formats.tables import Columns
from bufgym.traces.formats.workloads import read_workload_csv
from bufgym.traces.motion import MotionSettings, motion_from_poses
from bufgym.traces.poses import gaps_between, longest_s
from bufgym.traces.sheet import Facts, Sheet, time_facts
from bufgym.traces.trace import US_PER_S, Float64Array, Int64Array
from bufgym.traces.workload import Workload
from bufgym.utils.errors import BufgymError


def read_workload(
    path: StrPath | Sequence[StrPath],
    *,
    topics: Sequence[str] | None = None,
    odom: str | None = None,
    settings: MotionSettings | None = None,
    bridge_gaps: bool = False,
    clock: str = "log",
    columns: Columns | None = None,
    advance: Callable[[int], object] = int,
) -> Workload:
    """Read a recording of a robot (see `bags.read_bag`) or a workload CSV, recognised by the first bytes.

    Args:
        path: the file or folder; several recordings are read as one.
        topics: names, or patterns such as ``/camera/*``; by default all. They share one queue.
        odom: the topic whose motion gives x (recordings only; see `bags.read_bag`).
        settings: how motion is measured, by default `MotionSettings()`.
        bridge_gaps: take motion across a gap as the straight way from its first pose to its last (before the first
            pose and after the last: none); otherwise a gap is an error.
        clock: the clock of a recording's arrivals (see `bags.read_bag`).
        columns: of any other table, which columns hold times, bytes and topics.
        advance: called with 1 for each message of a recording read, as a progress bar's update.
    """
    if not isinstance(path, str | PathLike) and len(path) == 1:
        path = path[0]
    if isinstance(path, str | PathLike) and not is_recording(path):
        if odom is not None and Path(path).exists():
            raise BufgymError(f"{path}: odom = {odom!r}: needs a recording, which this is not")
        return _with_topics(read_workload_csv(path, columns), topics)
    if columns is not None:
        raise BufgymError(f"{path}: columns are of a table, which a recording is not")
    bag = bags.read_bag(path, odom, advance, clock)
    return workload_from_bag(bag, topics=topics, settings=settings, bridge_gaps=bridge_gaps)


def workload_from_bag(
    bag: bags.Bag,
    *,
    topics: Sequence[str] | None = None,
    settings: MotionSettings | None = None,
    bridge_gaps: bool = False,
) -> Workload:
    """The messages of these topics, with x from the bag's poses if it was read with some. See `read_workload`."""
    settings = settings or MotionSettings()
    names, chosen, topic = _on_topics(bag.path, list(bag.topics), bag.topic, topics)
    if not chosen.any():
        raise BufgymError(f"{bag.path}: no message on {', '.join(names) or 'any topic'}")
    time_ns = bag.time_ns[chosen]
    with heard() as doubts:
        # Of all topics, as one alone may send now and then.
        inside = (bag.time_ns >= time_ns[0]) & (bag.time_ns <= time_ns[-1])
        plausible.warn_of_pauses(
            bag.path, (bag.time_ns[inside] - time_ns[0]) // 1000, bag.topic[inside], list(bag.topics)
        )
        x, gaps, facts = _motion_at(time_ns, bag, settings, bridge_gaps)
    facts = (*time_facts("messages", (time_ns - time_ns[0]) // 1000, int(time_ns[0]) // 1000), *bag.sheet.facts, *facts)
    measured = ""
    if bag.poses is not None:
        view = f"{settings.fov_deg:g} degrees, {settings.scene_scale_m:g} m"
        measured = f", motion from {bag.poses.format}: {view}"
    source = f"{bag.path} ({bag.kind}{measured})"
    if len(names) < len(bag.topics):
        others = ", ".join(name for name in bag.topics if name not in names)
        source += f"; {np.count_nonzero(~chosen):,} messages left out, on topics not chosen: {others}"
    name = trace_name(re.sub(r"(\.mcap|\.bag|\.db3)?(\.zstd)?$", "", bag.path))
    sheet = Sheet(facts, (*bag.sheet.doubts, *doubts))
    return Workload(name, (time_ns - time_ns[0]) // 1000, bag.size_bytes[chosen], topic, names, x, source, gaps, sheet)


def _motion_at(
    time_ns: Int64Array, bag: bags.Bag, settings: MotionSettings, bridge_gaps: bool
) -> tuple[Float64Array | None, tuple[tuple[int, int], ...], Facts]:
    """x of messages at these times, from 0, the gaps in the poses between them, and facts; None without poses."""
    if bag.poses is None:
        return None, (), ()
    motion = motion_from_poses(bag.poses, settings)
    for doubt in motion.sheet.doubts:
        warn(bag.path, doubt)
    time_us = (time_ns - bag.poses_from_ns) // 1000
    gaps = _gaps(time_us, bag.poses.time_us, settings.max_gap_s)
    if gaps and not bridge_gaps:
        start, _ = max(gaps, key=lambda gap: gap[1] - gap[0])
        count = f"{len(gaps)} gaps" if len(gaps) > 1 else "a gap"
        raise BufgymError(
            f"{bag.path}: {bag.poses.format} has {count} of more than {settings.max_gap_s:g} s without a pose, the "
            f"longest {longest_s(gaps):.1f} s, at {start / US_PER_S:.1f} s: say --bridge-gaps (bridge_gaps=True) to "
            "take motion across as even, or choose other odometry or topics"
        )
    # Before the first pose and after the last no motion is known: np.interp holds its ends.
    x = np.interp(time_us, motion.time_us, motion.coordinate)
    return x - x[0], gaps, tuple(fact for fact in motion.sheet.facts if fact[0] not in ("start", "step"))


def _gaps(arrival_us: Int64Array, pose_us: Int64Array, max_gap_s: float) -> tuple[tuple[int, int], ...]:
    """Stretches without a pose from the first message to the last, in microseconds from the first message."""
    first, last = int(arrival_us[0]), int(arrival_us[-1])
    inside = pose_us[(pose_us > first) & (pose_us < last)]
    # Motion before the first message does not matter, but the last pose before it tells where that message is.
    before = first if pose_us[0] > first else int(pose_us[pose_us <= first][-1])
    after = last if pose_us[-1] < last else int(pose_us[pose_us >= last][0])
    edges_us = np.concatenate([[before], inside, [after]])
    return tuple((start - first, end - first) for start, end in gaps_between(edges_us, max_gap_s))


def _with_topics(workload: Workload, patterns: Sequence[str] | None) -> Workload:
    """The workload with these topics alone; its clock and its x begin with their first message."""
    if patterns is None:
        return workload
    names, chosen, topic = _on_topics(workload.source, workload.topics, workload.topic, patterns)
    arrival_us = workload.arrival_us[chosen]
    return replace(
        workload,
        arrival_us=arrival_us - arrival_us[0],
        size_bytes=workload.size_bytes[chosen],
        topic=topic,
        topics=names,
        x=None if workload.x is None else workload.x[chosen] - workload.x[chosen][0],
    )


def _on_topics(
    source: str, topics: Sequence[str], topic: Int64Array, patterns: Sequence[str] | None
) -> tuple[tuple[str, ...], npt.NDArray[np.bool_], Int64Array]:
    """The topics that fit, which messages they have (bool[n]), and these messages' topics by their new numbers."""
    names = bags.matching(source, topics, patterns)
    places = {name: k for k, name in enumerate(topics)}
    numbers = [places[name] for name in names]
    chosen = np.isin(topic, numbers)
    renumbered = np.zeros(len(topics), np.int64)
    renumbered[numbers] = np.arange(len(numbers))
    return tuple(names), chosen, renumbered[topic[chosen]]
