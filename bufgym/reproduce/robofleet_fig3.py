"""Fig. 3 of the Robofleet paper: latency and throughput against the publish rate of one PointCloud2 topic, 100 Mbit/s.

With n_T = 1 one message is on its way and one waits, the newest; with every topic no_drop all wait. The size of a
cloud, the round trip and how long it is published are not in the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from bufgym.reproduce.report import COLOURS, Report
from bufgym.reproduce.robofleet_evaluation import (
    MBIT,
    POINTS,
    RIVALS,
    ROUND_TRIP_MS,
    Row,
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

SENDERS = ("robofleet", "no-drop", "no-drop-released")
LOW = 2.0
"""Latency up to so many times that of the lowest rate is called low."""
GROWN = 10.0
"""Latency beyond so many times that of the lowest rate is called grown."""


def report(
    rates_hz: Sequence[float] = (5, 10, 20, 30, 40, 50, 60, 70, 80, 90, 100, 120),
    mbit_per_s: float = 100.0,
    points: int = POINTS,
    round_trip_ms: float = ROUND_TRIP_MS,
    duration_s: float = 20.0,
    runs: int = 5,
) -> Report:
    """Fig. 3 for these publish rates.

    Args:
        mbit_per_s: of the link, which is steady.
        points: of a cloud, 16 bytes each.
        round_trip_ms: half of it to the server, the whole from a message's crossing to its pong.
        duration_s: how long is published; without drops the latency depends on it.
        runs: differ by arrival jitter.
    """
    all_above_0("rates_hz", rates_hz)
    above_0("mbit_per_s", mbit_per_s)
    above_0("duration_s", duration_s)
    at_least_0("round_trip_ms", round_trip_ms)
    whole("runs", runs)
    rates_hz = sorted(rates_hz)
    size = cloud_bytes(points)[1]
    link = steady(mbit_per_s * MBIT)
    rows: list[Row] = []
    for rate in rates_hz:
        streams = (stream("PointCloud2", rate, points=points),)
        for name in SENDERS:
            for seed in range(runs):
                sent = meet(name, streams, link, duration_s, seed, round_trip_ms=round_trip_ms)
                latency_s = sent.got.latency_s
                rows.append(
                    {
                        "sender": name,
                        "publish_hz": rate,
                        "run": seed,
                        "latency_ms": 1e3 * float(latency_s.mean()),
                        "p95_latency_ms": 1e3 * p95(latency_s),
                        "last_latency_ms": 1e3 * float(latency_s[-1]),
                        "received_hz": sent.received_hz(duration_s),
                        "received_mbit_per_s": sent.received_hz(duration_s) * size / MBIT,
                        "dropped": len(sent) - len(latency_s),
                    }
                )

    def value(name: str, rate: float, column: str) -> float:
        return mean_of(rows, column, sender=name, publish_hz=rate)

    link_hz = mbit_per_s * MBIT / size
    paced_hz = 1 / (1 / link_hz + round_trip_ms / 1e3)
    low, high = rates_hz[0], rates_hz[-1]
    ratio = {name: value(name, high, "latency_ms") / value(name, low, "latency_ms") for name in SENDERS}
    enough = high > link_hz
    text = [
        f"Robofleet paper, Fig. 3: one PointCloud2 topic of {size:,} bytes over {mbit_per_s:g} Mbit/s, "
        f"{duration_s:g} s, mean of {runs} runs.",
        "",
        f"{'':12}{'latency, ms':^30}{'received, messages/s':^30}",
        f"{'publish, Hz':12}" + "".join(f"{_short(name):>10}" for name in SENDERS) * 2,
        *(
            f"{rate:<12g}"
            + "".join(f"{value(name, rate, 'latency_ms'):10.1f}" for name in SENDERS)
            + "".join(f"{value(name, rate, 'received_hz'):10.1f}" for name in SENDERS)
            for rate in rates_hz
        ),
        "n_T = 1: drops as published; no_drop: as published, paced by pongs too; released: flushed past n_T.",
        "",
        f"The link carries {link_hz:.1f} clouds/s; n_T = 1 sends one per transmission and round trip of "
        f"{round_trip_ms:g} ms: {paced_hz:.1f}/s.",
    ]
    if enough:
        text += [
            "Paper: with backpressure latency stays low when the rate exceeds the link, paid by fewer messages: "
            f"{holds(ratio['robofleet'] <= LOW and value('robofleet', high, 'received_hz') < high)}.",
            f"  At {high:g} Hz {value('robofleet', high, 'latency_ms'):.1f} ms, {ratio['robofleet']:.2f} times that at "
            f"{low:g} Hz; {value('robofleet', high, 'received_hz'):.1f} messages/s arrive. (Low: up to {LOW:g} times.)",
            f"Paper: with all no_drop latency grows: {holds(ratio['no-drop'] >= GROWN)}.",
            f"  At {high:g} Hz {value('no-drop', high, 'latency_ms') / 1e3:.2f} s on average, "
            f"{ratio['no-drop']:.0f} times that at {low:g} Hz ({ratio['no-drop-released']:.0f} times as released), and "
            f"{value('no-drop', high, 'last_latency_ms') / 1e3:.1f} s for the last message.",
            "  It grows for as long as the overload lasts.",
        ]
    else:
        text.append(f"No publish rate here exceeds the link: the paper's claims cannot be tested up to {high:g} Hz.")
    text += [
        "With n_T = 1 latency is highest just above the rate that pongs allow: there the message that waits is oldest.",
        "The paper's size and round trip are not known; its knee lies at other rates accordingly.",
    ]

    def draw(figure: Any) -> None:
        latency, received = figure.subplots(1, 2)
        for k, name in enumerate(SENDERS):
            look = {**style(name), "markersize": 4 + 2 * k, "zorder": 3 - 0.1 * k}  # equal lines stay visible
            for axes, column in ((latency, "latency_ms"), (received, "received_hz")):
                means = [value(name, rate, column) for rate in rates_hz]
                axes.plot(rates_hz, means, label=RIVALS[name].label, **look)
        received.plot([0, high], [0, high], color=COLOURS["other"], linestyle=":", label="all that is published")
        latency.set(yscale="log", ylabel="mean latency, ms")
        received.set(ylabel="messages received per second", ylim=(0, 1.15 * min(high, link_hz)))
        for axes in (latency, received):
            axes.axvline(link_hz, color=COLOURS["oracle"], linestyle="--", linewidth=1)
            axes.set(xlabel="publish rate, Hz", xlim=(0, 1.03 * high))
            axes.grid(alpha=0.25)
        received.annotate("the link's rate", (link_hz, 0), (-4, 6), textcoords="offset points", ha="right", fontsize=8)
        latency.set_title("Latency", loc="left")
        received.set_title("Throughput", loc="left")
        figure.legend(*received.get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)

    return Report("\n".join(text), *columns(rows), draw, (9.0, 4.2))


def _short(name: str) -> str:
    return {"robofleet": "n_T = 1", "no-drop": "no_drop", "no-drop-released": "released"}[name]
