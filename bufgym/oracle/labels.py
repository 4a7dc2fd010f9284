"""The dynamic programme behind the clairvoyant: which messages to send for the most information.

See docs/methods.md, "The clairvoyant, messages of equal sizes".
"""

from typing import NamedTuple

import numpy as np

from bufgym.jit import Floats, Ints, kernel
from bufgym.model.buffer import UNLIMITED_BYTES
from bufgym.model.qoi import value
from bufgym.oracle.pieces import Piece, most_from, walk
from bufgym.oracle.programme import Messages, Problem, new_problem
from bufgym.oracle.unequal import priced, without_idle

GRID = 16  # Grid steps to a message

SHARES = (1 / 16, 1 / 4, 1.0)
"""Distances below the upper bound at which to look for the optimum, as shares of the way down to a known plan."""

LABELS = 1 << 14  # Initial room for labels; it doubles whenever it runs out

_ROUNDING = 1e-9  # tolerance: the bounds add the same numbers in another order


class Labels(NamedTuple):
    """All labels, message by message; message i has ``first[i] : first[i + 1]``, by rising end and gain."""

    first: Ints  # int64[messages + 1], index of a message's first label
    latest: Ints  # int64[messages + 1], the latest end of any label at the messages before it
    end: Ints  # int64[room], the byte at which the label's last message ends
    gain: Floats  # float64[room], the gain in H by the messages so far
    parent: Ints  # int64[room], the label before it; -1 at the first message of a plan


def best(messages: Messages) -> tuple[Ints, float]:
    """Find the best plan; return its messages in order and its gain, H - 1."""
    n = len(messages.c)
    messages = without_idle(messages, messages.grid(GRID))
    problem = new_problem(messages, messages.limit, GRID)
    priced(problem, np.zeros((2, n)), 1, 1)
    # Equal sizes always fit where ``limit`` allows them, so the plan of a walk needs no other check.
    sent, begin = np.empty((2, n), np.int64)
    *_, low = walk(problem, Piece(0, n, n, n), 0, messages, n, UNLIMITED_BYTES, sent, begin, 0, 0)
    high = most_from(problem, n)
    labels = no_labels(n)
    for share in SHARES:
        enough = high - share * (high - low)
        labels = fill(problem, enough, labels)
        plan, gain = plan_of(labels)
        if gain >= enough:
            break
    return plan, gain


def no_labels(messages: int) -> Labels:
    """Make room for the labels of so many messages."""
    first, latest = np.zeros((2, messages + 1), np.int64)
    return Labels(first, latest, np.empty(LABELS, np.int64), np.empty(LABELS), np.empty(LABELS, np.int64))


def fill(problem: Problem, enough: float, labels: Labels) -> Labels:
    """Compute all labels that can lead to a gain of ``enough``, in the arrays of ``labels`` or in larger ones."""
    i = extend(problem, enough, 0, labels)
    while i < len(problem.c):
        room = 2 * len(labels.end)
        end, parent = np.resize(labels.end, room), np.resize(labels.parent, room)
        labels = labels._replace(end=end, gain=np.resize(labels.gain, room), parent=parent)
        i = extend(problem, enough, i, labels)
    return labels


def plan_of(labels: Labels) -> tuple[Ints, float]:
    """Messages on the way to the best label (the last one if several are equal) and its gain; none and 0 if none is
    sent.
    """
    count = int(labels.first[-1])
    if count == 0:
        return np.zeros(0, np.int64), 0.0
    # The last of equal labels: it may have sent more messages than the others.
    label = count - 1 - int(np.argmax(labels.gain[:count][::-1]))
    gain, way = float(labels.gain[label]), []
    while label >= 0:
        way.append(label)
        label = int(labels.parent[label])
    return np.searchsorted(labels.first, np.array(way[::-1]), side="right") - 1, gain


@kernel
def after(p: Problem, i: int, e: int) -> float:
    """Look up ``future`` of message i that ends at byte e."""
    return float(p.future[i, e // p.grid - p.c[i] // p.grid])


@kernel
def extend(p: Problem, enough: float, begin: int, labels: Labels) -> int:
    """Compute the labels of messages ``begin``, begin + 1, ...; return the one at which the room ran out, or n."""
    first, latest, end, gain = labels.first, labels.latest, labels.end, labels.gain
    room, enough = len(end), enough - _ROUNDING
    for i in range(begin, len(p.c)):
        at = stop = first[i]
        c_i, limit = p.c[i], min(p.limit[i], p.ends - p.size[i] - p.c[i])
        if stop + 2 > room:
            return i
        if limit >= 0 and after(p, i, c_i + p.size[i]) >= enough:
            end[stop], gain[stop], labels.parent[stop] = c_i + p.size[i], 0.0, -1
            stop += 1
        for j in range(i - 1, -1, -1):
            too_early = p.idle[i] if j < p.between[i] else -1
            if limit < 0 or latest[j + 1] <= too_early:
                break
            added = -1.0
            for k in range(first[j + 1] - 1, first[j] - 1, -1):
                if end[k] <= too_early:
                    break
                s = max(end[k], c_i)
                if s - c_i > limit:
                    continue
                if added < 0:
                    added = value(p.v, p.x[i] - p.x[j])
                if gain[k] + added + after(p, i, s + p.size[i]) >= enough:
                    stop = insert(labels, at, stop, s + p.size[i], gain[k] + added, k)
                    if stop == room:
                        return i
                if s == c_i:
                    break  # earlier ends of j do not let i begin earlier, and have gained less
        first[i + 1] = stop
        latest[i + 1] = max(latest[i], end[stop - 1] if stop > at else 0)
    return len(p.c)


@kernel
def insert(labels: Labels, at: int, stop: int, e: int, g: float, label: int) -> int:
    """Insert (e, g) among the labels ``at..stop`` unless one is better, drop the labels it beats, return the new stop.

    ``label`` is its parent. A new label replaces an equal one, as its way there began with an older message.
    """
    end, gain, parent = labels.end, labels.gain, labels.parent
    low, high = at, stop
    while low < high:  # find the first label that ends later than e
        middle = (low + high) // 2
        if end[middle] <= e:
            low = middle + 1
        else:
            high = middle
    if low > at and (gain[low - 1] > g or (gain[low - 1] == g and end[low - 1] < e)):
        return stop
    if low > at and end[low - 1] == e:
        low -= 1
    beaten = low
    while beaten < stop and gain[beaten] <= g:
        beaten += 1
    moved = low + 1 - beaten
    if moved > 0:
        for k in range(stop, low, -1):
            end[k], gain[k], parent[k] = end[k - 1], gain[k - 1], parent[k - 1]
    elif moved < 0:
        for k in range(beaten, stop):
            end[k + moved], gain[k + moved], parent[k + moved] = end[k], gain[k], parent[k]
    end[low], gain[low], parent[low] = e, g, label
    return stop + moved
