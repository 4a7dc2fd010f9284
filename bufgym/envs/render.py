"""Pictures of one sender: kept and dropped messages as a timeline against the link's capacity.

``ansi`` gives a few lines of text, ``rgb_array`` an image of constant size. Both read the sender's arrays and change
nothing. The height of the capacity is measured in demand (the bytes that arrive per second): full height is twice the
demand, so wherever the capacity is below half height, messages must wait or go.

With several topics each has a lane of its own, and a letter by which the queued messages are told apart.
"""

from __future__ import annotations

import itertools
import string
from collections.abc import Iterable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from bufgym.model.link import position_at
from bufgym.sim import ARRIVAL_WAITS, SOCKET_WAITS, Senders

DELIVERED, SENDING, QUEUED, DROPPED, NEWCOMER = range(5)
_NAMES = ("delivered", "in transmission", "queued", "dropped", "newcomer")

# What text shows for each fate, and its ANSI colour (green, blue, yellow, red, bold magenta).
_MARKS = "●▶■·?"
_ANSI = ("32", "34", "33", "31", "1;35")
_LEVELS = "_▁▂▃▄▅▆▇█"
_LABEL, _TOPIC_LABEL = 10, 16
"""Columns that a line's label takes; where labels are topics' names."""
_NARROWEST = 60
"""Fewer columns than this can't hold the counts."""

# What images show for each fate.
_COLOURS = ("#2a9d5c", "#2f6fde", "#e0a100", "#d1495b", "#8e3bb8")
_WIDTH_PX, _HEIGHT_PX, _DPI = 800, 400, 100
_WINDOW_S = 10.0
"""Length of the time axis, s; longer while an older message is still held."""
_BINS = 150
"""Points of the capacity curve."""
_MOST_BOXES = 64
"""Up to this L every slot is drawn as a box, beyond it as one bar."""
_MOST_NAMES = 24
"""So many lanes have room for their topics' names."""
_LETTERS = string.ascii_letters


class _Scene(NamedTuple):
    """What both pictures show of one sender."""

    now_us: int
    arrivals: NDArray[Any]
    """MESSAGE[arrived so far, and the newcomer]"""
    log: NDArray[np.int64]
    """The fate of each of them."""
    queue: NDArray[np.int64]
    """Sequence numbers of the queued messages, 0 = oldest."""
    dequeued: int
    """Sequence number of the message that the socket took last; -1 if none."""
    capacity: int
    demand: float
    """Bytes that arrive per second; 0 where that has no meaning (one message)."""
    counts: dict[str, int]
    qoi: float
    topics: tuple[str, ...]
    """Names of the topics; none where there is one queue."""
    asks: str
    """Who asks for a decision; empty where there is one queue, or nobody does."""

    def letter(self, seq: int) -> str:
        """What stands for the topic of a message."""
        return _LETTERS[int(self.arrivals["topic"][seq]) % len(_LETTERS)]


def _scene(senders: Senders, i: int) -> _Scene:
    episode = senders.episodes[i]
    if episode is None:
        raise gym.error.ResetNeeded("call reset() before render()")
    sender = senders.batch.senders[i]
    arrived, waiting = int(sender["next"]), int(sender["waiting"] == ARRIVAL_WAITS)
    planned = episode.arrivals
    arrivals = planned[: arrived + waiting]
    met = senders.batch.log[i, : arrived + waiting]
    log = np.full(arrived + waiting, QUEUED)
    log[met["dequeued_us"] >= 0] = SENDING
    log[met["transmitted_us"] >= 0] = DELIVERED
    log[met["dropped_us"] >= 0] = DROPPED
    log[arrived:] = NEWCOMER
    first, occupancy = int(sender["first"]), int(sender["occupancy"])
    queue = senders.batch.slots["seq"][i, first : first + occupancy].copy()
    dequeued = int(senders.batch.slots["seq"][i, first - 1]) if sender["dequeued"] > 0 else -1
    span_us = int(planned["arrival_us"][-1] - planned["arrival_us"][0])
    # n messages span n - 1 periods.
    demand = 1e6 * float(planned["size_bytes"][:-1].sum()) / span_us if span_us > 0 else 0.0
    counts = {name: int((log[:arrived] == entry).sum()) for entry, name in enumerate(_NAMES[:NEWCOMER])}
    names = tuple(topic.name for topic in senders.topics)
    first_of_all = float(sender["transmitted"] > 0)
    asks = ""
    if names:
        rules = senders.batch.topics[i]
        first_of_all = float(rules["weight"][rules["received"] > 0].sum())
        asks = {ARRIVAL_WAITS: "an arrival asks", SOCKET_WAITS: "the socket asks"}.get(int(sender["waiting"]), "")
    qoi = first_of_all + float(sender["delivered_gain"])
    now_us = int(sender["now_us"])
    return _Scene(now_us, arrivals, log, queue, dequeued, senders.capacity, demand, counts, qoi, names, asks)


def _rates(senders: Senders, i: int, edges_us: NDArray[np.int64]) -> NDArray[np.float64]:
    """Mean link capacity between neighbouring ``edges_us``, bytes per second."""
    batch, sender = senders.batch, senders.batch.senders[i]
    first, last, after = int(sender["first_knot"]), int(sender["last_knot"]), int(sender["after"])
    offset_us = int(sender["offset_us"])
    reached = [
        position_at(batch.knot_us, batch.knot_bytes, first, last, after, first, int(t_us) + offset_us)[0]
        for t_us in edges_us
    ]
    return 1e6 * np.diff(np.array(reached, np.float64)) / np.maximum(1, np.diff(edges_us))


def _speed(bytes_per_s: float) -> str:
    return f"{bytes_per_s / 1e6:.1f} MB/s" if bytes_per_s >= 1e6 else f"{bytes_per_s / 1e3:.0f} KB/s"


# --- text ------------------------------------------------------------------------------------------------------------


def _mark(entry: int) -> str:
    return _painted([(_ANSI[entry], _MARKS[entry])])


def _painted(marks: Iterable[tuple[str, str]]) -> str:
    """(colour, character) pairs as text; neighbours of one colour share its codes."""
    runs = itertools.groupby(marks, key=lambda mark: mark[0])
    return "".join(f"\x1b[{colour}m{''.join(text for _, text in run)}\x1b[0m" for colour, run in runs)


def ansi(senders: Senders, i: int, width: int = 100) -> str:
    """Sender ``i`` as lines of text: counts, link capacity, messages, queue (``width`` >= 60 columns), legend.

    One column of the capacity and of the messages is one arrival: its mark below, the link's mean capacity from it to
    the next one above. The latest arrivals are shown, as many as fit. With several topics there is a line of messages
    for each, and the queue is a row of their letters.
    """
    scene = _scene(senders, i)
    width, label = max(width, _NARROWEST), _TOPIC_LABEL if scene.topics else _LABEL
    shown = slice(max(0, len(scene.log) - (width - label)), None)
    counts = scene.counts
    held = f"{counts['in transmission']} in transmission, {len(scene.queue)}/{scene.capacity} queued"
    lines = [
        f"{scene.now_us / 1e6:8.3f} s  {sum(counts.values())} arrived: {counts['delivered']} delivered, "
        + f"{held}, {counts['dropped']} dropped; H = {scene.qoi:.2f}",
        "capacity".ljust(label) + _capacity_line(senders, i, scene, shown),
        *_message_lines(scene, shown, label),
        "queue".ljust(label) + (_topic_queue_line if scene.topics else _queue_line)(scene, width - label),
        " " * _LABEL
        + "  ".join(f"{_mark(entry)} {name}" for entry, name in enumerate(_NAMES))
        + "  _ empty"
        + (f"  {scene.asks}" if scene.topics else "  \x1b[31m9\x1b[0m missing"),
    ]
    if scene.demand > 0:
        lines.append(
            " " * _LABEL
            + f"full height {_speed(2 * scene.demand)}, twice the demand; \x1b[31mred\x1b[0m: below the demand"
        )
    return "\n".join(lines) + "\n"


def _capacity_line(senders: Senders, i: int, scene: _Scene, shown: slice) -> str:
    edges_us = np.append(scene.arrivals["arrival_us"][shown], scene.now_us)
    rates = _rates(senders, i, np.maximum.accumulate(edges_us))
    if scene.log[-1] == NEWCOMER and len(rates) > 1:
        # No time has passed since the newcomer arrived.
        rates[-1] = rates[-2]
    full = 2 * scene.demand or max(1.0, rates.max(initial=0.0))
    heights = np.ceil(np.clip(rates / full, 0, 1) * (len(_LEVELS) - 1)).astype(int)
    return _painted(
        ("31" if rate < scene.demand else "36", _LEVELS[height]) for rate, height in zip(rates, heights, strict=True)
    )


def _message_lines(scene: _Scene, shown: slice, label: int) -> list[str]:
    """A mark for each message; a line for each topic."""
    marks = [(_ANSI[entry], _MARKS[entry]) for entry in scene.log[shown]]
    if not scene.topics:
        return ["messages".ljust(label) + _painted(marks)]
    numbers = scene.arrivals["topic"][shown].tolist()
    lines = []
    for k, name in enumerate(scene.topics):
        own = [mark if number == k else ("0", " ") for mark, number in zip(marks, numbers, strict=True)]
        lines.append(f"{_LETTERS[k % len(_LETTERS)]} {name}"[: label - 1].ljust(label) + _painted(own))
    return lines


def _topic_queue_line(scene: _Scene, columns: int) -> str:
    """The topics' letters: of the message taken last, of the slots, and of the newcomer."""
    letters = [(_ANSI[int(scene.log[scene.dequeued])], scene.letter(scene.dequeued))] if scene.dequeued >= 0 else []
    letters += [(_ANSI[QUEUED], scene.letter(seq)) for seq in scene.queue.tolist()]
    letters += [("0", "_")] * (scene.capacity - len(scene.queue))
    last = [(_ANSI[NEWCOMER], scene.letter(-1))] if scene.log[-1] == NEWCOMER else []
    room = columns // 2 - len(last)
    if len(letters) > room:
        letters = [*letters[: room - 2], ("0", "...")]
    return " ".join(_painted([mark]) for mark in letters + last)


def _queue_line(scene: _Scene, columns: int) -> str:
    """The message taken last, the slots and the newcomer, with the number of messages missing between neighbours."""
    parts: list[tuple[int, str]] = []  # (columns, text)
    before = scene.dequeued
    if before >= 0:
        entry = int(scene.log[before])
        parts.append((1, _mark(entry)))
    waiting = [len(scene.arrivals) - 1] if scene.log[-1] == NEWCOMER else []
    free = scene.capacity - len(scene.queue)
    last: list[tuple[int, str]] = []
    for k, seq in enumerate([*scene.queue.tolist(), *waiting]):
        missing = seq - before - 1
        into = parts if k < len(scene.queue) else last
        if missing > 0:
            into.append((len(str(missing)), f"\x1b[31m{missing}\x1b[0m"))
        into.append((1, _mark(QUEUED if k < len(scene.queue) else NEWCOMER)))
        before = seq
    parts += [(1, "_")] * min(free, columns)
    room = columns - sum(n + 1 for n, _ in last) - len("... ")
    if sum(n + 1 for n, _ in parts) > room:
        while sum(n + 1 for n, _ in parts) > room:
            parts.pop()
        parts.append((3, "..."))
    return " ".join(text for _, text in parts + last)


# --- image -----------------------------------------------------------------------------------------------------------


def rgb_array(senders: Senders, i: int) -> NDArray[np.uint8]:
    """Sender ``i`` as an image uint8[400, 800, 3]: link capacity, messages by fate over time, and the slots."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise gym.error.DependencyNotInstalled(
            "render_mode='rgb_array' needs matplotlib: pip install bufgym[plot]"
        ) from error
    scene = _scene(senders, i)
    figure = Figure(figsize=(_WIDTH_PX / _DPI, _HEIGHT_PX / _DPI), dpi=_DPI)
    canvas: Any = FigureCanvasAgg(figure)  # its methods have no types
    ratios = (2, 4.2, 0.9) if scene.topics else (3, 3, 1.1)
    link, timeline, slots = figure.subplots(
        3, 1, height_ratios=ratios, gridspec_kw={"left": 0.155, "right": 0.985, "top": 0.93, "bottom": 0.03}
    )
    figure.subplots_adjust(hspace=0.42)
    now_s = scene.now_us / 1e6
    held = np.isin(scene.log, (SENDING, QUEUED, NEWCOMER))
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
    canvas.draw()
    return np.asarray(canvas.buffer_rgba(), np.uint8)[..., :3].copy()


def _draw_link(axes: Any, senders: Senders, i: int, scene: _Scene, start_s: float) -> None:
    start_us = min(int(start_s * 1e6), scene.now_us)
    edges_us = np.linspace(start_us, scene.now_us, _BINS + 1).astype(np.int64)
    rates = _rates(senders, i, edges_us) / 1e3
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


def _draw_timeline(axes: Any, scene: _Scene) -> None:
    """One lane for each fate, so that kept and dropped messages stay apart where they are dense."""
    arrival_s = scene.arrivals["arrival_us"] / 1e6
    lanes = (3, 2, 1, 0, 1)  # the newcomer stands in line with the queue
    for entry, lane in enumerate(lanes):
        of_entry = arrival_s[scene.log == entry]
        axes.plot(
            of_entry,
            np.full(len(of_entry), lane),
            linestyle="none",
            marker="D" if entry == NEWCOMER else "|" if entry in (DELIVERED, DROPPED) else "s",
            markersize=9 if entry in (DELIVERED, DROPPED) else 5,
            markeredgewidth=1.2,
            color=_COLOURS[entry],
        )
    axes.set_ylim(-0.6, 3.6)
    axes.set_yticks((3, 2, 1, 0), _NAMES[:NEWCOMER])
    for tick, entry in zip(axes.get_yticklabels(), range(NEWCOMER), strict=True):
        tick.set_color(_COLOURS[entry])
    axes.grid(axis="y", color="#eeeeee")
    axes.set_axisbelow(True)
    axes.set_xlabel("time of arrival (s)", fontsize=8, labelpad=1)


def _draw_lanes(axes: Any, scene: _Scene) -> None:
    """One lane for each topic: what was dropped below, what waits on the line, what the socket took above."""
    arrival_s, lanes = scene.arrivals["arrival_us"] / 1e6, len(scene.topics)
    tall = 190 / lanes  # of a lane, in points, a little less
    shifts, sizes = (0.2, 0.2, 0.0, -0.24, 0.0), (0.4, 0.4, 0.25, 0.3, 0.3)
    for entry, (shift, size) in enumerate(zip(shifts, sizes, strict=True)):
        chosen = scene.log == entry
        axes.plot(
            arrival_s[chosen],
            -scene.arrivals["topic"][chosen] + shift,
            linestyle="none",
            marker="D" if entry == NEWCOMER else "s" if entry == QUEUED else "|",
            markersize=max(2.0, min(9.0, size * tall)),
            markeredgewidth=1.2 if entry != SENDING else 2.5,
            color=_COLOURS[entry],
            label=_NAMES[entry],
        )
    axes.set_ylim(-lanes + 0.4, 0.6)
    axes.set_yticks(-np.arange(lanes))
    axes.set_yticklabels(
        [f"{name[:16]} {_LETTERS[k % len(_LETTERS)]}" for k, name in enumerate(scene.topics)]
        if lanes <= _MOST_NAMES
        else [""] * lanes,
        fontsize=8 if lanes <= _MOST_NAMES // 2 else 6,
    )
    axes.set_ylabel("" if lanes <= _MOST_NAMES else f"{lanes} topics", fontsize=9)
    axes.grid(axis="y", color="#eeeeee")
    axes.set_axisbelow(True)
    axes.set_xlabel("time of arrival (s)", fontsize=8, labelpad=1)
    handles = axes.legend(
        loc="lower left", bbox_to_anchor=(-0.01, 0.97), ncols=5, frameon=False, fontsize=8, columnspacing=1.2
    ).legend_handles
    for handle in handles:
        handle.set_markersize(6)


def _draw_slots(axes: Any, scene: _Scene) -> None:
    """The buffer's slots, head first; between neighbours the number of messages missing there; then the newcomer."""
    from matplotlib.patches import Rectangle

    L, occupancy = scene.capacity, len(scene.queue)
    newcomer = scene.log[-1] == NEWCOMER
    axes.set_axis_off()
    axes.set_ylim(0, 1)
    axes.text(-0.012, 0.5, f"slots {occupancy}/{L}", transform=axes.transAxes, ha="right", va="center", fontsize=9)
    if L > _MOST_BOXES:
        axes.set_xlim(0, L)
        axes.add_patch(Rectangle((0, 0.2), L, 0.6, facecolor="#f4f4f4", edgecolor="#999999"))
        axes.add_patch(Rectangle((0, 0.2), occupancy, 0.6, facecolor=_COLOURS[QUEUED]))
        return
    axes.set_xlim(-0.3, L + 1.4)
    before = scene.dequeued
    seqs = [*scene.queue.tolist(), *([len(scene.arrivals) - 1] if newcomer else [])]
    for k in range(L):
        colour = _COLOURS[QUEUED] if k < occupancy else "#f4f4f4"
        axes.add_patch(Rectangle((k + 0.25, 0.15), 0.6, 0.7, facecolor=colour, edgecolor="#999999"))
    if newcomer:
        axes.add_patch(Rectangle((L + 0.65, 0.15), 0.6, 0.7, facecolor=_COLOURS[NEWCOMER], edgecolor="#999999"))
    if scene.topics:
        for k, seq in enumerate(seqs):
            at = k + 0.55 if k < occupancy else L + 0.95
            axes.text(at, 0.5, scene.letter(seq), ha="center", va="center", fontsize=8 if L <= 32 else 6, color="white")
        axes.text(L + 0.95, 0.0, scene.asks, ha="right", va="top", fontsize=8, color="#555555")
        return
    if newcomer:
        if L <= 16:
            axes.text(L + 0.95, 0.5, "new", ha="center", va="center", fontsize=8, color="white")
    for k, seq in enumerate(seqs):
        missing, before = seq - before - 1, seq
        if missing > 0 and L <= 32:
            at = k + 0.05 if k < occupancy else L + 0.4
            axes.text(at, 0.5, f"{missing}", ha="center", va="center", fontsize=8 if L <= 16 else 6, color="#d1495b")


__all__ = ["ansi", "rgb_array"]
