"""Long episodes in pieces: a good plan and a close upper bound, in time and memory about linear in the messages.

See docs/methods.md, "The clairvoyant, long episodes".
"""

import os
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from bufgym.jit import Ints, kernel
from bufgym.model.qoi import value
from bufgym.oracle.programme import Messages, Problem, find_idle
from bufgym.oracle.unequal import priced, without_idle
from bufgym.utils.progress import bar

CELLS = 128  # Grid steps within a message's reach: the more, the closer the bound
MOST_CELLS = 512  # The same at most where even a step a message makes more of them
PIECE = 1 << 14  # Most messages of a piece
MARGIN = 1 << 11  # Least messages after a piece that its programme looks at as well


class Piece(NamedTuple):
    """Messages ``begin : stop`` of an episode, and how far beyond them its programme looks."""

    begin: int
    stop: int
    reached: int  # in a plan worth making, no message from here on follows one before ``stop``
    end: int  # the programme has the messages before this one


def best(messages: Messages, certain: Ints, capacity: int, max_bytes: int) -> tuple[Ints, float]:
    """Find messages of a plan that keeps to L and B, in order, and an upper bound of any such plan's gain, H - 1.

    ``certain``, int64[messages], is explained at ``new_problem``.
    """
    n, mean = len(messages.c), int(messages.size.mean())
    grid = max(1, mean // max(1, CELLS * mean // max(1, messages.reach)), messages.reach // MOST_CELLS)
    messages = without_idle(messages, grid)
    between, idle = np.empty((2, n), np.int64)
    find_idle(*messages[:3], certain, between, idle)
    pieces = cut(messages, between, idle, grid, PIECE, MARGIN)
    sent, begin = np.empty((2, n), np.int64)
    length, e = 0, 0
    first, beyond = np.zeros((2, len(pieces)))
    before: Problem | None = None
    with bar(len(pieces), True, unit="piece") as advance:
        for k, (piece, p) in enumerate(_solved(messages, between, idle, grid, pieces)):
            if before is not None:
                beyond[k] = _more(before, p, piece.begin - pieces[k - 1].begin, pieces[k - 1].reached - piece.begin)
            first[k] = most_from(p, piece.stop - piece.begin)
            base = int(messages.c[piece.begin]) // grid * grid
            length, e, _ = walk(p, piece, base, messages, capacity, max_bytes, sent, begin, length, e)
            before = p
            advance(1)
    beyond_all = np.cumsum(beyond[::-1])[::-1] - beyond
    return sent[:length], float((first + beyond_all).max())


def cut(messages: Messages, between: Ints, idle: Ints, grid: int, length: int, margin: int) -> list[Piece]:
    """Cut an episode into pieces of ``length`` messages, which look at least ``margin`` messages beyond their own."""
    n, pieces, latest = len(messages.c), [], 0
    ends = messages.c + messages.limit + messages.size
    for begin in range(0, n, length):
        stop = min(begin + length, n)
        latest = max(latest, int(ends[begin:stop].max()))
        # From here on, a message between could be sent before every further one (see ``find_future``).
        beyond = (between[stop:] >= stop) & (idle[stop:] >= (latest // grid + 1) * grid)
        reached = stop + int(beyond.argmax()) if beyond.any() else n
        pieces.append(Piece(begin, stop, reached, min(n, stop + max(margin, 2 * (reached - stop)))))
    return pieces


def _solved(
    messages: Messages, between: Ints, idle: Ints, grid: int, pieces: list[Piece]
) -> Iterator[tuple[Piece, Problem]]:
    """Yield each piece with its programme, its ``future`` filled; a few are computed at a time."""

    def solve(piece: Piece) -> Problem:
        part, base = slice(piece.begin, piece.end), int(messages.c[piece.begin]) // grid * grid
        c, size, limit = messages.c[part] - base, messages.size[part], messages.limit[part]
        sliced = Messages(c, size, limit, messages.x[part], messages.v, messages.ends - base)
        cells = np.zeros((len(c), messages.reach // grid + 2))
        p = Problem(*sliced, between[part] - piece.begin, idle[part] - base, grid, cells)
        priced(p, np.zeros((2, len(c))), 1, 1)
        return p

    cores = min(os.cpu_count() or 1, 4)
    with ThreadPoolExecutor(cores) as pool:
        waiting: deque[tuple[Piece, Future[Problem]]] = deque()
        for piece in pieces:
            waiting.append((piece, pool.submit(solve, piece)))
            if len(waiting) > cores:
                one, future = waiting.popleft()
                yield one, future.result()
        while waiting:
            one, future = waiting.popleft()
            yield one, future.result()


def _more(before: Problem, p: Problem, shift: int, shared: int) -> float:
    """The most that ``p`` promises after one of its first messages beyond the promise of the piece before.

    They are messages ``shift`` and further in that piece. ``shared`` is how many of them can follow its own.
    """
    return max(0.0, float((p.future[:shared] - before.future[shift : shift + shared]).max(initial=0.0)))


@kernel
def most_from(p: Problem, until: int) -> float:
    """Upper bound of the gain of every plan that begins with one of the messages before ``until``."""
    gain = 0.0
    for i in range(until):
        if p.limit[i] >= 0 and p.c[i] + p.size[i] <= p.ends:
            gain = max(gain, p.future[i, (p.c[i] + p.size[i]) // p.grid - p.c[i] // p.grid])
    return gain


@kernel
def walk(
    p: Problem,
    piece: Piece,
    base: int,
    messages: Messages,
    capacity: int,
    max_bytes: int,
    sent: Ints,
    begin: Ints,
    length: int,
    e: int,
) -> tuple[int, int, float]:
    """Continue a plan through one piece, taking always the best next message by ``future`` that finds room.

    ``sent`` and ``begin`` have its messages and the bytes at which they begin, ``length`` of each; the last ends at
    byte ``e``. Return both anew, and the gain of this part. Bytes of ``p`` are counted from ``base``.
    """
    gain = 0.0
    while length == 0 or sent[length - 1] < piece.stop:
        i = sent[length - 1] if length > 0 else -1
        best_look, chosen, chosen_s, chosen_gain = -1.0, -1, 0, 0.0
        for j in range(max(i + 1, piece.begin), piece.end):
            k = j - piece.begin
            if i >= 0 and p.between[k] + piece.begin > i and p.idle[k] + base >= e:
                break
            c, size = messages.c[j], messages.size[j]
            s = max(e, c)
            if s - c > messages.limit[j] or s + size > messages.ends:
                continue
            added = value(messages.v, messages.x[j] - messages.x[i]) if i >= 0 else 0.0
            look = added + p.future[k, (s - base + size) // p.grid - p.c[k] // p.grid]
            if look <= best_look:
                continue
            queued, backlog, m = 1, size, length - 1
            while m >= 0 and begin[m] > c:
                queued += 1
                backlog += messages.size[sent[m]]
                m -= 1
            if queued <= capacity and backlog <= max_bytes:
                best_look, chosen, chosen_s, chosen_gain = look, j, s, added
        if chosen < 0:
            break
        sent[length], begin[length], e = chosen, chosen_s, chosen_s + messages.size[chosen]
        length += 1
        gain += chosen_gain
    return length, e, gain
