"""One sender as lines of text."""

import bisect
import itertools
import textwrap
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from bufgym.envs.render.scene import NEWCOMER, NO_ACTIONS, QUEUED, STATES, Scene, letter, link_rates, scene_of
from bufgym.sim import Senders

_MARKS = "●▶■·?"  # The character of each state
_GREEN, _BLUE, _YELLOW, _RED, _MAGENTA, _CYAN, _PLAIN = "32", "34", "33", "31", "1;35", "36", ""
"""ANSI colours; plain text gets no codes."""
_COLOURS = (_GREEN, _BLUE, _YELLOW, _RED, _MAGENTA)  # The colour of each state
_LEVELS = "_▁▂▃▄▅▆▇█"
_LABEL, _TOPIC_LABEL = 10, 16  # Columns of a line's label, and of a label that is a topic's name
_WIDTH = 100  # Columns of the picture


def ansi(senders: Senders, i: int, slot_actions: NDArray[np.int64] = NO_ACTIONS) -> str:
    """Sender ``i`` as lines of text: counts, link capacity, messages, queue, legend.

    One column of capacity and messages is one arrival: its mark below, and above it the link's mean capacity until the
    next arrival. The latest arrivals are shown, as many as fit. With several topics each has a line of messages, and
    the queue is a row of their letters. A line says what ``slot_actions`` drop.
    """
    scene = scene_of(senders, i, slot_actions)
    label = _TOPIC_LABEL if scene.topics else _LABEL
    latest = slice(max(0, len(scene.states) - (_WIDTH - label)), None)
    counts = scene.counts
    legend = "  ".join(f"{_painted([_mark(state)])} {name}" for state, name in enumerate(STATES)) + "  _ empty"
    lines = [
        f"{scene.now_us / 1e6:8.3f} s  {sum(counts.values())} arrived: {counts['delivered']} delivered, "
        f"{counts['in transmission']} in transmission, {len(scene.queue)}/{scene.capacity} queued, "
        f"{counts['dropped']} dropped; H = {scene.qoi:.2f}",
        "capacity".ljust(label) + _capacity_line(senders, i, scene, latest),
        *_message_lines(scene, latest, label),
        "queue".ljust(label) + (_topic_queue_line if scene.topics else _queue_line)(scene, _WIDTH - label),
        *(["actions".ljust(label) + _actions_line(scene, _WIDTH - label)] if scene.actions else []),
        " " * _LABEL + legend + (f"  {scene.question}" if scene.topics else f"  {_painted([(_RED, '9')])} missing"),
    ]
    if scene.demand > 0:
        mb_per_s = 2 * scene.demand / 1e6
        speed = f"{mb_per_s:.1f} MB/s" if mb_per_s >= 1 else f"{1e3 * mb_per_s:.0f} KB/s"
        height = f"full height {speed}, twice the demand"
        lines.append(" " * _LABEL + f"{height}; {_painted([(_RED, 'red')])}: below the demand")
    return "\n".join(lines) + "\n"


def _mark(state: int) -> tuple[str, str]:
    return _COLOURS[state], _MARKS[state]


def _painted(marks: Iterable[tuple[str, str]]) -> str:
    """Text of (colour, text) pairs; neighbours of one colour share its codes."""
    runs = [
        (colour, "".join(text for _, text in run)) for colour, run in itertools.groupby(marks, lambda mark: mark[0])
    ]
    return "".join(f"\x1b[{colour}m{text}\x1b[0m" if colour else text for colour, text in runs)


def _capacity_line(senders: Senders, i: int, scene: Scene, latest: slice) -> str:
    edges_us = np.append(scene.arrivals["arrival_us"][latest], scene.now_us)
    rates = link_rates(senders, i, np.maximum.accumulate(edges_us))
    if scene.newcomers and len(rates) > 1:
        # No time has passed since the newcomer arrived.
        rates[-1] = rates[-2]
    full = 2 * scene.demand or max(1.0, rates.max(initial=0.0))
    heights = np.ceil(np.clip(rates / full, 0, 1) * (len(_LEVELS) - 1)).astype(int)
    return _painted(
        (_RED if rate < scene.demand else _CYAN, _LEVELS[height]) for rate, height in zip(rates, heights, strict=True)
    )


def _message_lines(scene: Scene, latest: slice, label: int) -> list[str]:
    """Lines with a mark for each message, one line for each topic."""
    marks = [_mark(state) for state in scene.states[latest]]
    if not scene.topics:
        return ["messages".ljust(label) + _painted(marks)]
    numbers = scene.arrivals["topic"][latest].tolist()
    lines = []
    for k, name in enumerate(scene.topics):
        lane = [mark if number == k else (_PLAIN, " ") for mark, number in zip(marks, numbers, strict=True)]
        lines.append(f"{letter(k)} {name}"[: label - 1].ljust(label) + _painted(lane))
    return lines


def _topic_queue_line(scene: Scene, columns: int) -> str:
    """The topics' letters of the message that the socket took last, of the slots, and of the newcomer."""
    sent = [scene.dequeued] if scene.dequeued >= 0 else []
    letters = [(_COLOURS[int(scene.states[seq])], scene.letter(seq)) for seq in [*sent, *scene.queue.tolist()]]
    letters += [(_PLAIN, "_")] * (scene.capacity - len(scene.queue))
    return _fitted(letters, [(_COLOURS[NEWCOMER], scene.letter(seq)) for seq in scene.newcomers], columns)


def _queue_line(scene: Scene, columns: int) -> str:
    """The message that the socket took last, the slots and the newcomer, with the number missing between them."""
    slots: list[tuple[str, str]] = []
    last: list[tuple[str, str]] = []
    if scene.dequeued >= 0:
        slots.append(_mark(int(scene.states[scene.dequeued])))
    for k, (_, missing) in enumerate(scene.missing()):
        queued = k < len(scene.queue)
        marks = slots if queued else last
        if missing > 0:
            marks.append((_RED, str(missing)))
        marks.append(_mark(QUEUED if queued else NEWCOMER))
    slots += [(_PLAIN, "_")] * (scene.capacity - len(scene.queue))
    return _fitted(slots, last, columns)


def _actions_line(scene: Scene, columns: int) -> str:
    """What each action of candidates does, as far as it fits."""
    L = scene.capacity
    does = {L: "rejects the newcomer", L + 1: "accepts the newcomer"}
    words = [
        f"{a} {does.get(slot, f'drops slot {slot}')}"
        for a, slot in sorted((a, slot) for slot, a in scene.actions.items())
    ]
    return textwrap.shorten(", ".join(words), columns, placeholder=" ...")


def _fitted(marks: list[tuple[str, str]], last: list[tuple[str, str]], columns: int) -> str:
    """``marks`` and then ``last``, with spaces between; three dots replace the end of ``marks`` if they do not fit."""
    room = columns - sum(len(text) + 1 for _, text in last) - len("... ")
    ends = list(itertools.accumulate(len(text) + 1 for _, text in marks))
    if ends and ends[-1] > room:
        marks = [*marks[: bisect.bisect_right(ends, room)], (_PLAIN, "...")]
    return " ".join(_painted([mark]) for mark in marks + last)
