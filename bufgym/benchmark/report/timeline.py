"""Chart of one episode, message by message: the link's capacity above one lane per policy."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from bufgym.benchmark.report.charts import PALETTE, Chart, Context, set_lanes, svg

DROPPED, IN_GAP, KEPT, LEFT = 0, 1, 2, 3
"""Outcomes of a message: dropped, dropped within the longest gap, delivered, still queued at the end."""

_OUTCOMES = ("#a3abb540", "#e2884a", "#0072b2", "#a3abb5")
"""Colour of each, in a picture that is the same on light and dark pages."""


def timeline(context: Context) -> Chart | None:
    """Draw the link's capacity above one lane per policy; None if the run left no timeline."""
    episode = context.run.timeline
    if episode is None:
        return None
    alt = "Capacity of the link over time, and for each policy which messages were delivered and which were dropped"
    lanes = episode["policies"]
    names = sorted(lanes, key=lambda name: lanes[name]["qoi"])  # the best lane is on top
    return Chart("timeline", alt, [("", svg(lambda figure: _episode(figure, episode, names), 1.8 + 0.2 * len(names)))])


def longest_gap(x: Sequence[float], received: Sequence[int]) -> tuple[int, int] | None:
    """The consecutive messages received that are furthest apart in x, the first pair on ties; None with fewer."""
    return max(pairwise(received), key=lambda pair: x[pair[1]] - x[pair[0]], default=None)


def log(messages: int, lane: Mapping[str, Any], gap: tuple[int, int] | None) -> list[int]:
    """List each message's outcome in order of arrival."""
    outcomes = np.full(messages, LEFT)
    dropped = [entry[0] for entry in lane["dropped"]]
    outcomes[dropped] = DROPPED
    if gap is not None:
        outcomes[[seq for seq in dropped if gap[0] < seq < gap[1]]] = IN_GAP
    outcomes[[entry[0] for entry in lane["received"]]] = KEPT
    return [int(outcome) for outcome in outcomes]


def _episode(figure: Any, episode: Mapping[str, Any], names: Sequence[str]) -> None:
    from matplotlib.colors import ListedColormap

    at, x = episode["arrival_s"], episode["x"]
    link, lanes = figure.subplots(2, sharex=True, height_ratios=(1.2, 0.2 * len(names)))
    rate = [bytes_per_s * 8e-6 for bytes_per_s in episode["rate"]["bytes_per_s"]]
    link.fill_between(episode["rate"]["t_s"], rate, step="post", color=PALETTE["link"], alpha=0.3, linewidth=0.8)
    if episode.get("demand_bytes_per_s") is not None:
        link.axhline(episode["demand_bytes_per_s"] * 8e-6, color=PALETTE["vermillion"], linestyle="--")
    link.set(ylabel="Mbit/s", ylim=(0, None), xlim=(at[0], at[-1] if len(at) > 1 else at[0] + 1))
    gaps = [longest_gap(x, [entry[0] for entry in episode["policies"][name]["received"]]) for name in names]
    rows = [log(len(at), episode["policies"][name], gap) for name, gap in zip(names, gaps, strict=True)]
    # Each message's tick lasts until the next arrives.
    edges, colours = [*at, 2 * at[-1] - at[-2] if len(at) > 1 else at[-1] + 1], ListedColormap(_OUTCOMES)
    bounds = np.arange(len(names) + 1) - 0.5
    lanes.pcolormesh(edges, bounds, np.array(rows), cmap=colours, vmin=-0.5, vmax=3.5, rasterized=True)
    set_lanes(lanes, names)
    lanes.grid(visible=False)
    lanes.set_xlabel("time, s")
    numbers = [("QoI", "gap, x", "gap, s")]
    for name, gap in zip(names, gaps, strict=True):
        steps = ("–", "–") if gap is None else (f"{x[gap[1]] - x[gap[0]]:.2f}", f"{at[gap[1]] - at[gap[0]]:.1f}")
        numbers.append((f"{episode['policies'][name]['qoi']:.1f}", *steps))
    for place, column in zip((1.07, 1.14, 1.21), zip(*numbers, strict=True), strict=True):
        for lane, words in zip((len(names), *range(len(names))), column, strict=True):
            lanes.text(place, lane, words, ha="right", va="center", transform=lanes.get_yaxis_transform())
