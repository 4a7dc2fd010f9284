"""Fig. 7 of the Robofleet paper: latency of each topic as a robot drives into a bad zone.

PoseStamped at 10 Hz, LaserScan at 10 Hz, CompressedImage at 2 Hz; the zone begins at about message 430, which we count
on the topics of 10 Hz. How bad the zone was is not in the paper, nor which topic was no_drop, nor the priorities: here
the link falls from one steady rate to another, poses are no_drop, and priorities are those of Robofleet's example
client (localization 20, laser scans 2, images 1); lower ones of images are tried as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from bufgym.errors import BufgymError
from bufgym.reproduce.report import COLOURS, Report
from bufgym.reproduce.robofleet_evaluation import (
    BYTES,
    MBIT,
    QUEUE_SIZE,
    RIVALS,
    ROUND_TRIP_MS,
    Row,
    Sent,
    all_above_0,
    at_least_0,
    columns,
    holds,
    mean_of,
    meet,
    p95,
    stream,
    whole,
)
from bufgym.scenario import Stream
from bufgym.scenario.checks import above_0
from bufgym.traces import Trace

SENDERS = ("robofleet", "rosbridge", "ros-native")
TOPICS = {
    "PoseStamped": (10.0, {"priority": 20.0, "no_drop": True}),
    "LaserScan": (10.0, {"priority": 2.0}),
    "CompressedImage": (2.0, {"priority": 1.0}),
}
"""Kind -> publish rate, Hz, and what the operator asks of it."""
COUNTED_HZ = 10.0
KEPT = 2.0
"""A latency is kept whose median in the zone is within so many times that before it, own bytes slower as they are."""


def report(
    bad_mbit_per_s: Sequence[float] = (4.0, 2.0, 1.0, 0.5),
    good_mbit_per_s: float = 100.0,
    image_priorities: Sequence[float] = (1.0, 0.1, 0.01),
    bad_from: int = 430,
    bad_s: float = 30.0,
    after_s: float = 15.0,
    round_trip_ms: float = ROUND_TRIP_MS,
    queue_size: int = QUEUE_SIZE,
    runs: int = 5,
    shown_mbit_per_s: float | None = None,
) -> Report:
    """Fig. 7 for these rates in the bad zone.

    Args:
        good_mbit_per_s: of the link elsewhere.
        image_priorities: of Robofleet's images; the first in every zone, all of them in the one that is shown.
        bad_from: the message, of a topic of 10 Hz, with which the zone begins.
        bad_s: how long it lasts.
        after_s: how long the link is good again.
        round_trip_ms: half of it to the server, the whole from a message's crossing to its pong.
        queue_size: of native ROS, messages a topic.
        runs: differ by arrival jitter.
        shown_mbit_per_s: which zone the figure shows; by default the third, or the last.
    """
    all_above_0("bad_mbit_per_s", bad_mbit_per_s)
    all_above_0("image_priorities", image_priorities)
    numbers = {"good_mbit_per_s": good_mbit_per_s, "bad_s": bad_s, "after_s": after_s}
    for name, number in numbers.items():
        above_0(name, number)
    at_least_0("round_trip_ms", round_trip_ms)
    for name, count in (("runs", runs), ("queue_size", queue_size), ("bad_from", bad_from)):
        whole(name, count)
    shown = bad_mbit_per_s[min(2, len(bad_mbit_per_s) - 1)] if shown_mbit_per_s is None else shown_mbit_per_s
    if shown not in bad_mbit_per_s:
        raise BufgymError(f"shown_mbit_per_s = {shown!r}: must be one of bad_mbit_per_s")
    from_s = bad_from / COUNTED_HZ
    until_s = from_s + bad_s + after_s
    tried = [(bad, name, image_priorities[0]) for bad in bad_mbit_per_s for name in SENDERS]
    tried += [(shown, "robofleet", priority) for priority in image_priorities[1:]]
    rows: list[Row] = []
    seen: dict[str, Sent] = {}
    for bad, name, priority in tried:
        steps = [(from_s, good_mbit_per_s * MBIT), (bad_s, bad * MBIT), (after_s, good_mbit_per_s * MBIT)]
        link = Trace.steps(steps, after="hold")
        streams = _streams(priority)
        for seed in range(runs):
            sent = meet(name, streams, link, until_s, seed, round_trip_ms=round_trip_ms, queue_size=queue_size)
            if (bad, priority, seed) == (shown, image_priorities[0], 0):
                seen[name] = sent
            key = {"bad_mbit_per_s": bad, "sender": name, "image_priority": priority, "run": seed}
            for k, kind in enumerate(TOPICS):
                rows.append({**key, "topic": kind, **_entry(sent.on(k), from_s, from_s + bad_s)})

    def draw(figure: Any) -> None:
        panels = figure.subplots(len(SENDERS), 1, sharex=True, sharey=True)
        for axes, name in zip(panels, SENDERS, strict=True):
            _draw_sender(axes, seen[name], (from_s, from_s + bad_s))
            axes.set_title(RIVALS[name].label, loc="left", fontsize=10)
        top_s = max(float(np.nanmax(sent.latency_s)) for sent in seen.values())
        panels[-1].set_ylim(1e-3, 2 * top_s)
        panels[-1].set_xlabel("message of a 10 Hz topic (an image stands at the one of its time)")
        panels[-1].set_xlim(max(0.0, COUNTED_HZ * (from_s - 10)), COUNTED_HZ * until_s)
        figure.suptitle(
            f"Bad zone of {shown:g} Mbit/s; ticks along the bottom: dropped", x=0.01, ha="left", fontsize=11
        )
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)

    text = [
        f"Robofleet paper, Fig. 7: a bad zone from message {bad_from} of a 10 Hz topic ({from_s:g} s) for {bad_s:g} s; "
        f"{good_mbit_per_s:g} Mbit/s elsewhere.",
        f"n_T = 1, round trip {round_trip_ms:g} ms, native ROS with queues of {queue_size}; mean of {runs} runs.",
        "; ".join(_asked(kind) for kind in TOPICS) + ".",
        "",
        *_table([row for row in rows if row["image_priority"] == image_priorities[0]]),
        "",
        *_claims(rows, shown, image_priorities[0], good_mbit_per_s),
        "",
        f"The zone of {shown:g} Mbit/s with images of other priorities:",
        *_other_priorities(rows, shown, good_mbit_per_s),
    ]
    return Report("\n".join(text), *columns(rows), draw, (8.0, 7.2))


def _streams(image_priority: float) -> list[Stream]:
    changed: dict[str, dict[str, Any]] = {"CompressedImage": {"priority": image_priority}}
    return [stream(kind, hz, **(rules | changed.get(kind, {}))) for kind, (hz, rules) in TOPICS.items()]


def _entry(sent: Sent, from_s: float, until_s: float) -> Row:
    """What became of one topic before the zone and in it."""
    zone = sent.between(from_s, until_s)
    latency_s = zone.got.latency_s
    return {
        "median_before_ms": 1e3 * float(np.median(sent.between(0, from_s).got.latency_s)),
        "median_in_zone_ms": 1e3 * float(np.median(latency_s)) if len(latency_s) else math.nan,
        "p95_in_zone_ms": 1e3 * p95(latency_s),
        "arrived_in_zone": len(zone),
        "lost_in_zone": len(zone) - len(latency_s),
        "lost": len(sent) - len(sent.got),
    }


def _asked(kind: str) -> str:
    hz, rules = TOPICS[kind]
    return f"{kind} {hz:g} Hz, " + ("no_drop" if rules.get("no_drop") else f"priority {rules['priority']:g}")


def _table(rows: Sequence[Row]) -> list[str]:
    lines = [
        f"{'':28}" + "".join(f"{kind:^28}" for kind in TOPICS),
        f"{'zone':12}{'':16}" + f"{'median':>9}{'95 %':>9}{'lost':>7}   " * len(TOPICS),
    ]
    for bad in dict.fromkeys(row["bad_mbit_per_s"] for row in rows):
        for name in SENDERS:
            cells = []
            for kind in TOPICS:
                where = {"bad_mbit_per_s": bad, "sender": name, "topic": kind}
                median, high = (mean_of(rows, f"{which}_in_zone_ms", **where) for which in ("median", "p95"))
                lost = mean_of(rows, "lost_in_zone", **where) / mean_of(rows, "arrived_in_zone", **where)
                cells.append(f"{median:9,.0f}{high:9,.0f}{lost:7.0%}   ")
            zone = f"{bad:g} Mbit/s" if name == SENDERS[0] else ""
            lines.append(f"{zone:12}{RIVALS[name].label.split(',')[0]:16}" + "".join(cells))
    return [*lines, "Latency in ms of messages that came in the zone, and the part of them that was dropped."]


def _claims(rows: Sequence[Row], shown: float, image_priority: float, good: float) -> list[str]:
    ours = [row for row in rows if row["sender"] == "robofleet"]
    demand = sum(BYTES[kind][1] * hz for kind, (hz, _) in TOPICS.items()) / MBIT
    lost = sum(row["lost"] for row in ours if row["topic"] == "PoseStamped")
    lines = [
        f"Robofleet's messages take {demand:.2f} Mbit/s in all.",
        f"Paper: no_drop is never lost: {holds(lost == 0)} ({lost} poses lost in all runs and zones).",
        "Paper: images are dropped, small prioritised messages keep their latency:",
        _KEPT_HEADER,
        *(
            _kept(ours, f"{bad:g} Mbit/s", bad, image_priority, good)
            for bad in dict.fromkeys(row["bad_mbit_per_s"] for row in ours)
        ),
    ]
    return [
        *lines,
        f"Kept: a median within {KEPT:g} times that before the zone plus what its own bytes take longer there.",
        "Nobody overtakes what is being sent: behind an image a pose waits for the rest of it, whatever its priority;",
        "and with nothing else waiting the socket takes an image, however low its own. Scans are dropped even where",
        "the link carries all: two that come during one image share one slot.",
        *_native(rows, shown, image_priority),
        _beside_rosbridge(rows, shown, image_priority),
        "Which topic was no_drop, the priorities and how bad the zone was are our choice; the paper does not say.",
    ]


def yes(claim: bool) -> str:
    return "yes" if claim else "NO"


def _native(rows: Sequence[Row], bad: float, image_priority: float) -> list[str]:
    """What becomes of native ROS's poses in one zone, and how much of that is owed to turns by message."""
    where = {"sender": "ros-native", "topic": "PoseStamped", "bad_mbit_per_s": bad, "image_priority": image_priority}
    lost = mean_of(rows, "lost_in_zone", **where) / mean_of(rows, "arrived_in_zone", **where)
    poses = BYTES["PoseStamped"][0] * TOPICS["PoseStamped"][0] / MBIT
    return [
        f"Native ROS loses {lost:.0%} of its poses in {bad:g} Mbit/s. Its topics take turns by message here: while "
        "images wait,",
        "a pose goes once an image, and a full queue makes what goes old. That is the model's doing: TCP shares by "
        "bytes,",
        f"and all poses take {poses:.3f} Mbit/s, where a third of the link is {bad / len(TOPICS):.2f}. How native ROS "
        "treats small topics",
        "beside large ones is not to be read from this figure.",
    ]


def _beside_rosbridge(rows: Sequence[Row], bad: float, image_priority: float) -> str:
    """The poses' median at every sender in one zone."""
    where = {"topic": "PoseStamped", "bad_mbit_per_s": bad, "image_priority": image_priority}
    medians_s = {name: mean_of(rows, "median_in_zone_ms", sender=name, **where) / 1e3 for name in SENDERS}
    shown = ", ".join(f"{RIVALS[name].label.split(',')[0]} {seconds:.2f} s" for name, seconds in medians_s.items())
    return f"Beside the others, poses in {bad:g} Mbit/s, median: {shown}."


_KEPT_HEADER = f"  {'':12}{'images dropped':>16}" + "".join(
    f"{f'{kind}, ms: median':>28}{'at most':>9}{'kept':>6}" for kind in ("PoseStamped", "LaserScan")
)


def _kept(ours: Sequence[Row], label: str, bad: float, image_priority: float, good: float) -> str:
    """Whether the claims hold for one zone and priority, with the numbers."""

    def value(kind: str, column: str) -> float:
        return mean_of(ours, column, topic=kind, bad_mbit_per_s=bad, image_priority=image_priority)

    images, of = (value("CompressedImage", column) for column in ("lost_in_zone", "arrived_in_zone"))
    line = f"  {label:12}{f'{yes(images > 0)}, {images:.0f} of {of:.0f}':>16}"
    for kind in ("PoseStamped", "LaserScan"):
        slower_ms = 1e3 * BYTES[kind][1] / MBIT * (1 / bad - 1 / good)
        allowed = KEPT * (value(kind, "median_before_ms") + slower_ms)
        within = value(kind, "median_in_zone_ms")
        line += f"{within:28.0f}{allowed:9.0f}{yes(within <= allowed):>6}"
    return line


def _other_priorities(rows: Sequence[Row], shown: float, good: float) -> list[str]:
    ours = [row for row in rows if row["sender"] == "robofleet" and row["bad_mbit_per_s"] == shown]
    return [
        _kept(ours, f"{priority:g}", shown, priority, good)
        for priority in dict.fromkeys(row["image_priority"] for row in ours)
    ]


def _draw_sender(axes: Any, sent: Sent, zone_s: tuple[float, float]) -> None:
    looks = {
        "PoseStamped": (COLOURS["afr"], "o"),
        "LaserScan": (COLOURS["drop-oldest"], "s"),
        "CompressedImage": (COLOURS["random"], "^"),
    }
    for k in reversed(range(len(TOPICS))):
        kind = list(TOPICS)[k]
        colour, marker = looks[kind]
        mine = sent.on(k)
        got = mine.got
        size = 5 if kind == "CompressedImage" else 2.5
        label = f"{kind}, {TOPICS[kind][0]:g} Hz"
        axes.plot(COUNTED_HZ * got.arrival_s, got.latency_s, marker, color=colour, markersize=size, label=label)
        gone = COUNTED_HZ * mine.arrival_s[np.isnan(mine.received_s)]
        # Dropped ones: a tick along the bottom, a line a topic.
        height = np.full(len(gone), 0.03 + 0.045 * k)
        axes.plot(
            gone, height, "|", color=colour, markersize=5, markeredgewidth=0.6, transform=axes.get_xaxis_transform()
        )
    axes.axvspan(*(COUNTED_HZ * at_s for at_s in zone_s), color=COLOURS["other"], alpha=0.2, linewidth=0)
    axes.set(yscale="log", ylabel="latency, s")
    axes.grid(alpha=0.25)
