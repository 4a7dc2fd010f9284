"""One sender as an image."""

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bufgym.envs.render.scene import (
    DROPPED,
    NEWCOMER,
    NO_ACTIONS,
    QUEUED,
    SENDING,
    STATES,
    Scene,
    letter,
    link_rates,
    scene_of,
)
from bufgym.sim import Senders
from bufgym.utils.errors import install

COLOURS = ("#2a9d5c", "#2f6fde", "#e0a100", "#d1495b", "#8e3bb8")
"""The colour of each state."""
_GREY, _EMPTY, _RED = "#999999", "#f4f4f4", COLOURS[DROPPED]
_WIDTH_PX, _HEIGHT_PX, _DPI = 800, 400, 100
_WINDOW_S = 10.0  # Length of the time axis, s; it grows while an older message is still held
_BINS = 150  # Points of the capacity curve
_MOST_BOXES = 64  # Largest L for which every slot is drawn as a box; above it, one bar
_MOST_NAMES = 24  # Most lanes with room for their topics' names


def rgb_array(senders: Senders, i: int, slot_actions: NDArray[np.int64] = NO_ACTIONS) -> NDArray[np.uint8]:
    """Sender ``i`` as an image uint8[400, 800, 3]: link capacity, messages by state over time, and the slots.

    A slot has the number of the action that drops it, if ``slot_actions`` has one.

    Raises ResetNeeded without an episode, DependencyNotInstalled without matplotlib (the extra ``plot``).
    """
    figure, canvas = canvas_of()
    scene = scene_of(senders, i, slot_actions)
    ratios = (2, 4.2, 0.9) if scene.topics else (3, 3, 1.1)
    link, timeline, slots = figure.subplots(
        3, 1, height_ratios=ratios, gridspec_kw={"left": 0.155, "right": 0.985, "top": 0.93, "bottom": 0.03}
    )
    figure.subplots_adjust(hspace=0.42)
    now_s = scene.now_us / 1e6
    held = np.isin(scene.states, (SENDING, QUEUED, NEWCOMER))
    start_s = now_s - _WINDOW_S
    if held.any():
        start_s = min(start_s, float(scene.arrivals["arrival_us"][held][0]) / 1e6)
    start_s = max(0.0, start_s)
    end_s = max(start_s + _WINDOW_S, now_s)
    margin_s = 0.015 * (end_s - start_s)
    for axes in (link, timeline):
        axes.set_xlim(start_s - margin_s, end_s + margin_s)
        axes.axvline(now_s, color="black", linewidth=1)
        axes.spines[["top", "right"]].set_visible(False)
        axes.tick_params(labelsize=8)
    _draw_link(link, senders, i, scene, start_s)
    (_draw_lanes if scene.topics else _draw_timeline)(timeline, scene)
    _draw_slots(slots, scene)
    return pixels(canvas)


def canvas_of(width_px: int = _WIDTH_PX, height_px: int = _HEIGHT_PX) -> tuple[Any, Any]:
    """Make a figure and its canvas of the given size, px; DependencyNotInstalled without matplotlib."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise gym.error.DependencyNotInstalled(
            f"render_mode='rgb_array' needs matplotlib: {install('plot')}"
        ) from error
    figure = Figure(figsize=(width_px / _DPI, height_px / _DPI), dpi=_DPI)
    return figure, FigureCanvasAgg(figure)


def pixels(canvas: Any) -> NDArray[np.uint8]:
    """The canvas as an image, uint8[height, width, 3]."""
    canvas.draw()
    return np.asarray(canvas.buffer_rgba(), np.uint8)[..., :3].copy()


def _draw_link(axes: Any, senders: Senders, i: int, scene: Scene, start_s: float) -> None:
    start_us = min(int(start_s * 1e6), scene.now_us)
    edges_us = np.linspace(start_us, scene.now_us, _BINS + 1).astype(np.int64)
    rates = link_rates(senders, i, edges_us) / 1e3
    demand = scene.demand / 1e3
    top = 2 * demand or max(1.0, 1.1 * float(rates.max()))
    axes.stairs(np.minimum(rates, top), edges_us / 1e6, fill=True, color="#9cc3e6")
    axes.set_ylim(0, 1.05 * top)
    axes.set_ylabel("capacity", fontsize=9)
    if demand > 0:
        axes.axhline(demand, color="#555555", linestyle="--", linewidth=1)
        axes.set_yticks((0, demand, top), ("0 KB/s", f"demand {demand:.0f}", f"{top:.0f}"))
    counts = scene.counts
    axes.set_title(
        f"t = {scene.now_us / 1e6:.2f} s:  {sum(counts.values())} arrived,  {counts['delivered']} delivered,  "
        f"{counts['in transmission']} in transmission,  {len(scene.queue)} queued,  {counts['dropped']} dropped;  "
        f"H = {scene.qoi:.2f}",
        fontsize=9,
        loc="left",
    )


def _draw_timeline(axes: Any, scene: Scene) -> None:
    """Draw one lane for each state, so that kept and dropped messages stay apart where they are dense."""
    lanes = np.array((3, 2, 1, 0, 1))  # the newcomer stands in line with the queue
    _draw_messages(axes, scene, lanes[scene.states], "|ss|D", (9, 5, 5, 9, 5), 1.2)
    axes.set_ylim(-0.6, 3.6)
    axes.set_yticks((3, 2, 1, 0), STATES[:NEWCOMER])
    for tick, colour in zip(axes.get_yticklabels(), COLOURS[:NEWCOMER], strict=True):
        tick.set_color(colour)


def _draw_lanes(axes: Any, scene: Scene) -> None:
    """Draw one lane for each topic: dropped messages below the line, waiting ones on it, sent ones above."""
    lanes = len(scene.topics)
    lane_points = 190 / lanes  # a little less than the height of a lane
    offsets = np.array((0.2, 0.2, 0.0, -0.24, 0.0))
    sizes = [max(2.0, min(9.0, share * lane_points)) for share in (0.4, 0.4, 0.25, 0.3, 0.3)]
    _draw_messages(axes, scene, -scene.arrivals["topic"] + offsets[scene.states], "||s|D", sizes, 2.5)
    named = lanes <= _MOST_NAMES
    axes.set_ylim(-lanes + 0.4, 0.6)
    axes.set_yticks(-np.arange(lanes))
    axes.set_yticklabels(
        [f"{name[:16]} {letter(k)}" if named else "" for k, name in enumerate(scene.topics)],
        fontsize=8 if lanes <= _MOST_NAMES // 2 else 6,
    )
    axes.set_ylabel("" if named else f"{lanes} topics", fontsize=9)
    handles = axes.legend(
        loc="lower left", bbox_to_anchor=(-0.01, 0.97), ncols=5, frameon=False, fontsize=8, columnspacing=1.2
    ).legend_handles
    for handle in handles:
        handle.set_markersize(6)


def _draw_messages(
    axes: Any, scene: Scene, heights: NDArray[Any], markers: str, sizes: Sequence[float], sending_width: float
) -> None:
    """Draw a marker for each message at its time of arrival and ``heights``; markers and sizes (points) go by state."""
    arrival_s = scene.arrivals["arrival_us"] / 1e6
    for state, name in enumerate(STATES):
        chosen = scene.states == state
        axes.plot(
            arrival_s[chosen],
            heights[chosen],
            linestyle="none",
            marker=markers[state],
            markersize=sizes[state],
            markeredgewidth=sending_width if state == SENDING else 1.2,
            color=COLOURS[state],
            label=name,
        )
    axes.grid(axis="y", color="#eeeeee")
    axes.set_axisbelow(True)
    axes.set_xlabel("time of arrival (s)", fontsize=8, labelpad=1)


def _draw_slots(axes: Any, scene: Scene) -> None:
    """Draw the slots, head first, then the newcomer; between neighbours stands the number of messages missing there."""
    from matplotlib.patches import Rectangle

    L, occupancy = scene.capacity, len(scene.queue)
    axes.set_axis_off()
    axes.set_ylim(0, 1)
    axes.text(-0.012, 0.5, f"slots {occupancy}/{L}", transform=axes.transAxes, ha="right", va="center", fontsize=9)
    if L > _MOST_BOXES:
        axes.set_xlim(0, L)
        axes.add_patch(Rectangle((0, 0.2), L, 0.6, facecolor=_EMPTY, edgecolor=_GREY))
        axes.add_patch(Rectangle((0, 0.2), occupancy, 0.6, facecolor=COLOURS[QUEUED]))
        return

    def text(x: float, words: str, colour: str, size: int) -> None:
        axes.text(x, 0.5, words, ha="center", va="center", fontsize=size, color=colour)

    axes.set_xlim(-0.3, L + 1.4)
    boxes: list[tuple[float, str]] = [(k, COLOURS[QUEUED] if k < occupancy else _EMPTY) for k in range(L)]
    boxes += [(L + 0.4, COLOURS[NEWCOMER]) for _ in scene.newcomers]
    for left, colour in boxes:
        axes.add_patch(Rectangle((left + 0.25, 0.15), 0.6, 0.7, facecolor=colour, edgecolor=_GREY))
    lefts = [*range(occupancy), L + 0.4]
    for (seq, missing), left in zip(scene.missing(), lefts, strict=False):
        if scene.topics:
            text(left + 0.55, scene.letter(seq), "white", 8 if L <= 32 else 6)
        elif missing > 0 and L <= 32:
            text(left + 0.05 if left < L else L + 0.4, f"{missing}", _RED, 8 if L <= 16 else 6)
    if scene.topics:
        axes.text(L + 0.95, 0.0, scene.question, ha="right", va="top", fontsize=8, color="#555555")
    elif scene.newcomers and L <= 16:
        rejects = f", {scene.actions[L]}" if L in scene.actions else ""
        text(L + 0.95, f"new{rejects}", "white", 8)
    for slot, action in scene.actions.items():
        if slot < L <= 32:
            text(slot + 0.55, f"{action}", "white", 9 if L <= 16 else 6)
    if scene.actions:
        accepts = f"; {scene.actions[L + 1]} accepts the newcomer" if L + 1 in scene.actions else ""
        axes.text(L + 1.3, 0.0, f"numbers: actions{accepts}", ha="right", va="top", fontsize=8, color="#555555")
