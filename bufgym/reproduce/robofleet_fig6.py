"""Fig. 6 of the Robofleet paper: latency against the number of consumers, 5 Hz point clouds over 12 Mbit/s.

Native ROS sends one copy to each consumer over the uplink, Robofleet one in all to its server, which copies. Only the
uplink is simulated: what the server's own links add is no part of this. Neither the size of a cloud nor the publisher's
queue is in the paper: of both two are shown, of the sizes one that the link can carry eight times. Counted is what is
received while clouds are published: what full queues hand over afterwards is no part of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.errors import BufgymError
from bufgym.reproduce.report import COLOURS, Report
from bufgym.reproduce.robofleet_evaluation import (
    MBIT,
    POINTS,
    QUEUE_SIZE,
    RIVALS,
    ROUND_TRIP_MS,
    Row,
    Sent,
    all_above_0,
    at_least_0,
    cloud_bytes,
    columns,
    holds,
    mean_of,
    meet,
    p95,
    stream,
    style,
    whole,
)
from bufgym.scenario.checks import above_0
from bufgym.traces.generate import steady

CONSTANT = 1.05
"""Robofleet's latency with the most consumers, to that with one: within this it is constant."""
STRAIGHT = 0.98
"""Correlation of native ROS's mean latency with the number of consumers from which on it is linear."""


def report(
    points: Sequence[int] = (1_500, POINTS),
    max_consumers: int = 8,
    rate_hz: float = 5.0,
    mbit_per_s: float = 12.0,
    round_trip_ms: float = ROUND_TRIP_MS,
    queue_sizes: Sequence[int] = (1, QUEUE_SIZE),
    duration_s: float = 60.0,
    runs: int = 5,
) -> Report:
    """Fig. 6 for clouds of so many points and 1 to ``max_consumers`` consumers.

    Args:
        points: of a cloud, 16 bytes each; one panel each.
        round_trip_ms: half of it to the server, the whole from a message's crossing to its pong.
        queue_sizes: of native ROS, messages to each consumer; one line each.
        duration_s: how long is published.
        runs: differ by arrival jitter.
    """
    if isinstance(points, int) or not points:
        raise BufgymError(f"points = {points!r}: need at least one number of points")
    if isinstance(max_consumers, bool) or not isinstance(max_consumers, int) or not 2 <= max_consumers <= 100:
        raise BufgymError(f"max_consumers = {max_consumers!r}: must be a whole number from 2 to 100")
    for name, number in (("rate_hz", rate_hz), ("mbit_per_s", mbit_per_s), ("duration_s", duration_s)):
        above_0(name, number)
    at_least_0("round_trip_ms", round_trip_ms)
    whole("runs", runs)
    all_above_0("queue_sizes", queue_sizes)
    for queue_size in queue_sizes:
        whole("queue_sizes", queue_size)
    link = steady(mbit_per_s * MBIT)
    consumers = range(1, max_consumers + 1)
    senders = [("robofleet", 1), *(("ros-native", queue) for queue in queue_sizes)]
    rows: list[Row] = []
    for size in points:
        topic = stream("PointCloud2", rate_hz, points=size)
        for n in consumers:
            for name, queue in senders:
                for seed in range(runs):
                    sent = meet(
                        name,
                        (topic,),
                        link,
                        duration_s,
                        seed,
                        round_trip_ms=round_trip_ms,
                        queue_size=queue,
                        consumers=n,
                    )
                    heard = sent.received_s <= duration_s
                    latency_s = sent.latency_s[heard]
                    key = {"points": size, "consumers": n, "sender": name, "queue_size": queue, "run": seed}
                    rows.append(
                        {
                            **key,
                            "mean_latency_s": float(latency_s.mean()) if len(latency_s) else math.nan,
                            "p95_latency_s": p95(latency_s),
                            "received_share": float(heard.mean()),
                            "least_received_share": least_share(sent, heard),
                        }
                    )

    def value(size: int, name: str, queue: int, column: str = "mean_latency_s") -> NDArray[np.float64]:
        """For each number of consumers."""
        one = {"points": size, "sender": name, "queue_size": queue}
        return np.array([mean_of(rows, column, consumers=n, **one) for n in consumers])

    text = [
        f"Robofleet paper, Fig. 6: PointCloud2 at {rate_hz:g} Hz over {mbit_per_s:g} Mbit/s. Native ROS sends a copy "
        "to each consumer,",
        f"Robofleet one in all; round trip {round_trip_ms:g} ms; mean of {runs} runs of {duration_s:g} s.",
    ]
    for size in points:
        text += ["", *_panel(size, list(consumers), queue_sizes, rate_hz / (mbit_per_s * MBIT), value)]
    text += [
        "",
        "Robofleet's uplink does the same whatever the number: constant by construction, up to what its server's own",
        "links add, which are not simulated. Copies follow one another: the k-th waits for k - 1 others, so that the",
        "mean grows by half a transmission a consumer, as long as the link carries them all. (Side by side, as TCP may",
        "send them, all end with the last: a whole transmission a consumer, linear as well.) Beyond, the connections",
        "take turns: the worst off receives about as much as the mean consumer, and all receive less the more they",
        "are. What still arrives is no older for that: full queues bound its latency, by their length in periods: a",
        "jump, then hardly more. The buffers of ROS's sockets, which would add to it, are not simulated.",
        "The paper's cloud and queue are not known, nor whether its copies exceeded the link.",
    ]

    def draw(figure: Any) -> None:
        small: dict[str, Any] = {"ha": "right", "fontsize": 8}
        panels = figure.subplots(1, len(points), squeeze=False)[0]
        for axes, size in zip(panels, points, strict=True):
            for k, (name, queue) in enumerate(senders):
                label = RIVALS[name].label.split(",")[0] + (f", queue of {queue}" if name == "ros-native" else "")
                look = style(name) | {"zorder": 3 - 0.1 * k}
                if k > 1:  # further queues: open and larger, so that equal lines stay visible
                    look |= {"linestyle": "--", "markersize": 5.5 + 2 * k, "markerfacecolor": "none"}
                axes.plot(list(consumers), value(size, name, queue), label=label, **look)
            fits = mbit_per_s * MBIT / (rate_hz * cloud_bytes(size)[0])
            if fits < max_consumers:
                axes.axvspan(max(fits, 0.8), max_consumers + 0.2, color=COLOURS["other"], alpha=0.15, linewidth=0)
                axes.annotate(
                    "copies exceed the link", (max_consumers, 0.5), xycoords=("data", "axes fraction"), **small
                )
            axes.set(xlabel="consumers", xlim=(0.8, max_consumers + 0.2), ylim=(0, None))
            axes.set_xticks(list(consumers))
            axes.set_title(f"{size:,} points, {cloud_bytes(size)[0] / 1000:.0f} kB", loc="left", fontsize=10)
            axes.grid(alpha=0.25)
        panels[0].set_ylabel("mean latency, s")
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)

    return Report("\n".join(text), *columns(rows), draw, (4.4 * len(points) + 0.4, 4.2))


def least_share(sent: Sent, heard: NDArray[np.bool_]) -> float:
    """Part of its messages that the consumer with the fewest received; ``heard``: which were."""
    per = np.bincount(sent.consumer, heard) / np.bincount(sent.consumer)
    return float(per.min())


def _panel(size: int, consumers: Sequence[int], queue_sizes: Sequence[int], per_byte: float, value: Any) -> list[str]:
    """One size: the table, and what it says. ``per_byte``: load of the link for each byte of a cloud."""
    ros, flatbuffer, _ = cloud_bytes(size)
    most = consumers[-1]
    carried = min(most, int(1 / (ros * per_byte)))
    own = value(size, "robofleet", 1)
    growth = own[-1] / own[0]
    lines = [
        f"{size:,} points, {ros:,} bytes as ROS binary, {flatbuffer:,} as flatbuffer: the link carries {carried} of "
        f"{most} copies.",
        f"  {'mean latency, s; consumers':32}" + "".join(f"{n:>8}" for n in consumers),
        f"  {'Robofleet':32}" + "".join(f"{seconds:8.3f}" for seconds in own),
    ]
    constant = f"{holds(growth <= CONSTANT)} ({growth:.2f} times from 1 to {most})"
    said = [f"  Paper: Robofleet's latency is near constant: {constant}."]
    for queue in queue_sizes:
        native = value(size, "ros-native", queue)
        received = value(size, "ros-native", queue, "received_share")
        least = value(size, "ros-native", queue, "least_received_share")
        straight = float(np.corrcoef(consumers, native)[0, 1])
        slope = float(np.polyfit(consumers, native, 1)[0])
        lines.append(f"  {f'native ROS, queue of {queue}':32}" + "".join(f"{seconds:8.3f}" for seconds in native))
        lines.append(f"  {'  received of its copies':32}" + "".join(f"{share:8.0%}" for share in received))
        lines.append(f"  {'  received by the worst off':32}" + "".join(f"{share:8.0%}" for share in least))
        said.append(
            f"  Paper: native ROS grows linearly: with a queue of {queue} {holds(straight >= STRAIGHT and slope > 0)} "
            f"({slope:.3f} s a consumer, r = {straight:.3f})."
        )
    return [*lines, *said]
