"""The two interfaces of one queue as a picture: three actions with candidates, L + 2 with slots.

python -m website.interfaces

It writes ``docs/figures/candidates.svg`` and needs matplotlib (extra ``plot``). The environment itself says which
messages are candidates.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import bufgym  # noqa: F401  (registers the environments)
from bufgym.model import Link
from bufgym.scenario import Episode, messages
from bufgym.traces import Trace
from bufgym.utils.libraries import library

FIGURE = Path(__file__).parents[1] / "docs" / "figures" / "candidates.svg"
X = np.array([0.0, 0.9, 1.6, 2.8, 3.15, 3.7, 4.9, 5.8, 6.2, 7.2])
"""Camera motion x of ten messages: one in transmission, eight queued, and the newcomer."""
L = len(X) - 2
CHEAPEST, SECOND, HEAD = "tab:orange", "goldenrod", "tab:blue"
NAMES = ("cheapest", "second", "head")
_PLAIN, _DIM = "0.75", "0.45"


def candidates() -> NDArray[np.int64]:
    """The slots that the three actions mean in this queue, int64[3]."""
    arrival_us = np.arange(len(X)) * 33_333
    episode = Episode(messages(arrival_us, 1_000_000, X), Link(Trace.steps([(10.0, 1e6)], name="slow")))
    env = gym.make("bufgym/Uplink-v1", capacity=L)
    _, info = env.reset(options={"episode": episode})
    return np.asarray(info["slots"])


def draw(path: Path) -> None:
    """Write the picture."""
    library("matplotlib", "plot").rcParams["svg.fonttype"] = "none"
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 5.4), layout="constrained")
    above, below = figure.subplots(2, 1, height_ratios=[1.15, 1], sharex=True)
    slots = candidates()
    colours = dict(zip(slots.tolist(), (CHEAPEST, SECOND, HEAD), strict=True))
    _draw_queue(above, colours)
    _draw_queue(below, {})
    above.set_title("candidates, the default: Discrete(3)", loc="left", fontsize=11, weight="bold")
    below.set_title(f'actions="slots": Discrete(L + 2), here L = {L}', loc="left", fontsize=11, weight="bold")
    for action, (slot, name) in enumerate(zip(slots.tolist(), NAMES, strict=True)):
        _draw_candidate(above, action, slot, name, colours[slot])
    for slot, x in enumerate(X[1:].tolist()):
        _button(below, x, str(slot), "reject" if slot == L else "evict", _PLAIN)
    _button(below, X[-1] + 0.8, str(L + 1), "accept: no room", "white")
    for axes in (above, below):
        axes.set(xlim=(-0.55, 8.9), yticks=[])
        axes.spines[["top", "right", "left", "bottom"]].set_visible(False)
        axes.tick_params(bottom=False, labelbottom=False)
    above.set_ylim(-1.15, 1.25)
    below.set_ylim(-1.3, 0.6)
    figure.supxlabel("how far the camera has moved when the message was taken (x)", fontsize=9)
    figure.savefig(path, metadata={"Date": None})


def _draw_queue(axes: Any, colours: dict[int, str]) -> None:
    """Draw the messages on the line of x, candidates in their colours, and the gap between each two."""
    axes.plot([X[0], X[-1]], [0, 0], color="0.8", linewidth=1, zorder=0)
    axes.plot(X[0], 0, "o", markersize=13, markerfacecolor="white", markeredgecolor=_DIM)
    axes.annotate("in transmission", (X[0], -0.42), ha="center", fontsize=8, color=_DIM)
    for slot, x in enumerate(X[1:].tolist()):
        shape = "s" if slot == L else "o"
        axes.plot(x, 0, shape, markersize=13, color=colours.get(slot, _PLAIN), markeredgecolor=_DIM)
    axes.annotate("newcomer", (X[-1], 0.25), ha="center", fontsize=8, color=_DIM)
    for left, right in zip(X[:-1].tolist(), X[1:].tolist(), strict=True):
        axes.annotate(f"{right - left:.2g}", ((left + right) / 2, -0.2), ha="center", fontsize=7, color=_DIM)


def _draw_candidate(axes: Any, action: int, slot: int, name: str, colour: str) -> None:
    """Draw the gap that would be left without the message, and its action."""
    left, right = X[slot], X[min(slot + 2, len(X) - 1)]
    height = 0.55 + 0.3 * (action == 1)
    axes.plot([left, left, right, right], [0.2, height, height, 0.2], color=colour, linewidth=1.5)
    axes.annotate(
        f"gap left {right - left:.2g}", ((left + right) / 2, height + 0.05), ha="center", fontsize=8, color=colour
    )
    _button(axes, X[slot + 1], str(action), name, colour)


def _button(axes: Any, x: float, action: str, name: str, colour: str) -> None:
    """Draw an action below the message that it drops."""
    box = {"boxstyle": "round,pad=0.35", "facecolor": colour, "edgecolor": _DIM}
    axes.annotate(action, (x, -0.62), ha="center", va="center", fontsize=10, bbox=box)
    axes.annotate(name, (x, -1.02), ha="center", va="center", fontsize=8)


if __name__ == "__main__":
    draw(FIGURE)
