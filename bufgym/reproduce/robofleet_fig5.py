"""Fig. 5 of the Robofleet paper: latency and throughput while capacity falls evenly from 100 to 4 Mbit/s in 15 s.

One PointCloud2 topic; its size and rate are not in the paper. A message's latency stands at the second in which it was
received; the link stays at its last rate for a while, so that what is late comes in too.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from bufgym.errors import BufgymError
from bufgym.reproduce.report import COLOURS, Report
from bufgym.reproduce.robofleet_evaluation import (
    JITTER,
    MBIT,
    POINTS,
    QUEUE_SIZE,
    RIVALS,
    ROUND_TRIP_MS,
    Row,
    at_least_0,
    cloud_bytes,
    columns,
    holds,
    mean_of,
    meet,
    stream,
    style,
    whole,
)
from bufgym.scenario.checks import above_0
from bufgym.traces.generate import ramp

SENDERS = ("robofleet", "no-drop", "ros-native")


def report(
    rate_hz: float = 30.0,
    from_mbit_per_s: float = 100.0,
    to_mbit_per_s: float = 4.0,
    fall_s: float = 15.0,
    stay_s: float = 5.0,
    points: int = POINTS,
    round_trip_ms: float = ROUND_TRIP_MS,
    queue_size: int = QUEUE_SIZE,
    runs: int = 5,
) -> Report:
    """Fig. 5 for this publish rate.

    Args:
        fall_s: how long capacity falls.
        stay_s: how long it then stays, and messages still come.
        points: of a cloud, 16 bytes each.
        round_trip_ms: half of it to the server, the whole from a message's crossing to its pong.
        queue_size: of native ROS, messages.
        runs: differ by arrival jitter.
    """
    numbers = {"rate_hz": rate_hz, "from_mbit_per_s": from_mbit_per_s, "to_mbit_per_s": to_mbit_per_s, "fall_s": fall_s}
    for name, number in numbers.items():
        above_0(name, number)
    for name, number in (("stay_s", stay_s), ("round_trip_ms", round_trip_ms)):
        at_least_0(name, number)
    for name, count in (("runs", runs), ("queue_size", queue_size)):
        whole(name, count)
    until_s = fall_s + stay_s
    if until_s < 2:
        raise BufgymError(f"fall_s + stay_s = {until_s}: must be at least 2")
    seconds = range(math.ceil(until_s))

    def capacity(at_s: float) -> float:
        """Mbit/s."""
        return from_mbit_per_s + (to_mbit_per_s - from_mbit_per_s) * min(at_s / fall_s, 1)

    link = ramp(from_mbit_per_s * MBIT, to_mbit_per_s * MBIT, fall_s)
    topic = stream("PointCloud2", rate_hz, points=points)
    rows: list[Row] = []
    for name in SENDERS:
        for seed in range(runs):
            sent = meet(name, (topic,), link, until_s, seed, round_trip_ms=round_trip_ms, queue_size=queue_size).got
            for second in seconds:
                latency_s = sent.latency_s[(second <= sent.received_s) & (sent.received_s < second + 1)]
                some = len(latency_s) > 0
                rows.append(
                    {
                        "sender": name,
                        "run": seed,
                        "second": second,
                        "link_mbit_per_s": capacity(second + 0.5),
                        "received": len(latency_s),
                        "mean_latency_s": float(latency_s.mean()) if some else math.nan,
                        "max_latency_s": float(latency_s.max()) if some else math.nan,
                    }
                )

    def value(name: str, second: int, column: str) -> float:
        return mean_of(rows, column, sender=name, second=second)

    def highest(name: str) -> float:
        return max(float(r["max_latency_s"]) for r in rows if r["sender"] == name and r["received"])

    ros, size, _ = cloud_bytes(points)
    last_s = size / (to_mbit_per_s * MBIT)
    # What goes is never older than a period, jitter included: a newer one would have overwritten it.
    bound_s = last_s + (1 + JITTER) / rate_hz + round_trip_ms / 2e3
    received = {name: sum(value(name, k, "received") for k in seconds) / (rate_hz * until_s) for name in SENDERS}
    short = {"robofleet": "n_T = 1", "no-drop": "no_drop", "ros-native": "native ROS"}
    text = [
        f"Robofleet paper, Fig. 5: capacity falls from {from_mbit_per_s:g} to {to_mbit_per_s:g} Mbit/s in {fall_s:g} s "
        f"and stays for {stay_s:g} s.",
        f"PointCloud2 of {size:,} bytes at {rate_hz:g} Hz ({rate_hz * size / MBIT:.1f} Mbit/s), round trip "
        f"{round_trip_ms:g} ms; native ROS: {ros:,} bytes,",
        f"a queue of {queue_size}; mean of {runs} runs.",
        "",
        f"{'':8}{'link,':>8}{'received in this second':^36}{'mean latency of these, s':^36}",
        f"{'second':8}{'Mbit/s':>8}" + "".join(f"{short[name]:>12}" for name in SENDERS) * 2,
        *(
            f"{k:<8}{capacity(k + 0.5):8.1f}"
            + "".join(f"{value(name, k, 'received'):12.1f}" for name in SENDERS)
            + "".join(f"{value(name, k, 'mean_latency_s'):12.3f}" for name in SENDERS)
            for k in seconds
        ),
        "",
        "Paper: low latency is bought with fewer messages: "
        f"{holds(highest('robofleet') <= bound_s and received['robofleet'] < 1)}.",
        f"  n_T = 1: never above {highest('robofleet'):.2f} s; low: up to {bound_s:.2f} s, which is a period, a cloud "
        f"at {to_mbit_per_s:g} Mbit/s ({last_s:.2f} s)",
        f"  and the way to the server. {received['robofleet']:.0%} of the messages arrive by the end.",
        f"  all no_drop: up to {highest('no-drop'):.2f} s by the end and rising; {received['no-drop']:.0%} arrive.",
        f"  native ROS: up to {highest('ros-native'):.2f} s, its queue; {received['ros-native']:.0%} arrive.",
        "Low is not constant: a cloud takes longer on a slower link. A queue that drops its oldest is bounded as well,",
        "by its length in periods; what grows is a queue that drops nothing.",
        "A message stands at the second of its receipt. The paper's rate, size and round trip are not known.",
    ]

    def draw(figure: Any) -> None:
        latency, rate = figure.subplots(2, 1, sharex=True)
        middle = np.array(seconds) + 0.5
        for name in reversed(SENDERS):
            for axes, column in ((latency, "mean_latency_s"), (rate, "received")):
                axes.plot(middle, [value(name, k, column) for k in seconds], label=RIVALS[name].label, **style(name))
        fine_s = np.linspace(0, until_s, 200)
        carried = [capacity(at_s) * MBIT / size for at_s in fine_s]
        rate.plot(fine_s, carried, color=COLOURS["oracle"], linestyle="--", linewidth=1.2, label="the link's clouds/s")
        rate.axhline(rate_hz, color=COLOURS["other"], linestyle=":", label="published")
        latency.set(yscale="log", ylabel="mean latency, s")
        rate.set(ylabel="messages received per second", xlabel="time, s", ylim=(0, 1.6 * rate_hz), xlim=(0, until_s))
        for axes in (latency, rate):
            axes.axvline(fall_s, color=COLOURS["other"], linewidth=1)
            axes.grid(alpha=0.25)
        fall = f"Capacity falls from {from_mbit_per_s:g} to {to_mbit_per_s:g} Mbit/s in {fall_s:g} s"
        latency.set_title(fall, loc="left", fontsize=10)
        figure.legend(*rate.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)

    return Report("\n".join(text), *columns(rows), draw, (7.5, 5.8))
