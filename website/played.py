"""What ``bufgym bench --mcap`` writes, as a picture: what arrived, what was dropped and the queue, over time.

``python -m website.played played.mcap 40 80 docs/figures/played.webp`` draws the seconds 40 to 80 of it. It needs mcap
and matplotlib (extras ``ros``, ``plot``).
"""

from __future__ import annotations

import json
import sys
from collections import defaultdict
from pathlib import Path

from bufgym.utils.libraries import library

WHAT = ("delivered", "dropped", "queue")

Series = dict[str, dict[str, list[tuple[float, int]]]]
"""Policy -> "delivered", "dropped" or "queue" -> (s from the first message on, messages so far or in the queue)."""


def series(file: Path) -> Series:
    """What the file says of each policy, in order of their names."""
    from mcap.reader import make_reader

    found: Series = defaultdict(lambda: {what: [] for what in WHAT})
    with file.open("rb") as opened:
        from_ns = None
        for _, channel, message in make_reader(opened).iter_messages():
            _, policy, what, *_ = channel.topic.split("/")
            from_ns = message.log_time if from_ns is None else from_ns
            points = found[policy][what]
            value = json.loads(message.data)["length"] if what == "queue" else len(points) + 1
            points.append(((message.log_time - from_ns) / 1e9, value))
    return dict(sorted(found.items()))


def draw(path: Path, found: Series, start_s: float, end_s: float) -> None:
    """Write a picture with a row for each policy: ticks of what is delivered and dropped above the queue's length."""
    library("matplotlib", "plot")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 1.7 * len(found) + 0.6), layout="constrained")
    rows = figure.subplots(len(found), sharex=True, sharey=True, squeeze=False)[:, 0]
    most = max(length for parts in found.values() for _, length in parts["queue"])
    for axes, (policy, parts) in zip(rows, found.items(), strict=True):
        times, lengths = zip(*parts["queue"], strict=True)
        axes.fill_between(times, lengths, step="post", color="0.8", lw=0, label="in the queue")
        for k, (what, colour) in enumerate((("delivered", "tab:blue"), ("dropped", "tab:red"))):
            inside = [time for time, _ in parts[what] if start_s <= time <= end_s]
            axes.eventplot(inside, lineoffsets=most + 2.5 - 1.5 * k, linelengths=1.1, lw=0.5, color=colour)
            axes.plot([], [], color=colour, label=what)
        axes.set_title(policy, loc="left", size="medium")
        axes.spines[["top", "right"]].set_visible(False)
    rows[0].set(xlim=(start_s, end_s), ylim=(0, most + 3.5), yticks=range(0, most + 1, max(1, most // 2)))
    rows[-1].set_xlabel("s")
    figure.legend(*rows[0].get_legend_handles_labels(), loc="outside upper right", frameon=False, ncols=3)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    draw(Path(sys.argv[4]), series(Path(sys.argv[1])), float(sys.argv[2]), float(sys.argv[3]))
