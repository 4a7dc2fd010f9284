"""Mahimahi packet-delivery traces: one whole number of ms a line, each a chance for one 1500-byte packet.

Format: the README of mahimahi's `traces/`, and `src/frontend/link_queue.cc` (R. Netravali et al., "Mahimahi",
USENIX ATC 2015). A repeated number is more than one packet in that ms. After the last line the trace begins
again, shifted by the last line's time.

How opportunities become capacity: the packets of ms m have crossed *at* m, so their bytes accrue at an even
rate during the ms that ends there, (m - 1, m]. Ms 0 has none before it; its packets accrue together with
those of ms 1. So the total is exactly 1500 bytes a line, no packet is through before its time, it lasts
as long as the last line says, and a file with the single line "1" is a steady 12 Mbit/s, as in mahimahi.

A gigabyte of lines can hold a hundred million such ms, more than memory should have to. A trace of more than
MAX_KNOTS knots is therefore taken in cells of 2 ms, 4 ms, ... instead, by the same rule: the packets of a cell accrue
evenly in it, the total and the duration stay exact, and the trace's `source` states the cell.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from bufgym.errors import TraceError, where
from bufgym.traces.files import MAX_LINE_CHARACTERS, MAX_LINES, Line, StrPath, TextFile, decoded
from bufgym.traces.readers_intervals import Knots
from bufgym.traces.trace import MAX_DURATION_S, Int64Array

PACKET_BYTES: Final = 1500
MAX_STAMP_MS: Final = MAX_DURATION_S * 1000

# 384 MB as arrays; seven hours of a link with packets in every ms.
MAX_KNOTS: Final = 24_000_000

_CHUNK_BYTES: Final = 4 * 2**20
_NEWLINE: Final = 10
_ZERO: Final = 48
_MAX_DIGITS: Final = len(str(MAX_STAMP_MS))
# Times in order have ever more digits, so a chunk holds few runs of equal width.
_MAX_RUNS: Final = 32


def read_mahimahi(path: StrPath) -> Knots:
    """Knots of the capacity: int64[K] microseconds and int64[K] bytes, both from 0, K <= MAX_KNOTS.

    The result takes 32 bytes a distinct ms at most, reading about twice that.

    Raises:
        TraceError: a line that is not a whole number from 0 to 10**10, a time before that of the line above,
            no line at all, or none after ms 0 (such a trace would have no duration).
    """
    knots = _KnotBuilder()
    last_ms = lines_before = odd_lines = 0
    for block in _blocks(path):
        values, lines = _fast_values(block, last_ms), block.count(b"\n")
        if values is None:
            odd_lines += lines
            if odd_lines > MAX_LINES:
                rule = f"more than {MAX_LINES} lines so far in blocks that are not all bare numbers: must be fewer"
                raise TraceError(where(path, lines_before + 1, None, rule))
            values = _slow_values(path, block, lines_before, last_ms)
        if values.size:
            knots.add(values)
            last_ms = int(values[-1])
        lines_before += lines
    if not knots.packets:
        raise TraceError(where(path, None, None, "is empty: must hold a line for each packet"))
    if last_ms == 0:
        raise TraceError(where(path, lines_before, 0, "the last time must be after ms 0", field="time in ms"))
    return knots.finish()


def _blocks(path: StrPath) -> Iterator[bytes]:
    """The file in pieces of whole lines, each with its line end."""
    carried, lines_before = b"", 0
    with TextFile(path) as file:
        while data := file.read(_CHUNK_BYTES, lines_before + 1):
            head, newline, tail = data.rpartition(b"\n")
            if newline:
                block = carried + head + newline
                lines_before += block.count(b"\n")
                yield block
                carried = tail
            else:
                carried += data
            if len(carried) > MAX_LINE_CHARACTERS:
                shown = carried[:60].decode("latin-1")
                rule = f"must be at most {MAX_LINE_CHARACTERS} characters"
                raise TraceError(where(path, lines_before + 1, shown, rule))
    if carried:
        yield carried + b"\n"


class _Busy(NamedTuple):
    """Cells of time that some packets crossed in: their ends int64[n] in ms, packets so far int64[n] up to each end."""

    ends_ms: Int64Array
    packets: Int64Array

    def last_of_each(self) -> _Busy:
        """Of entries with one and the same end the last, which counts the packets of all."""
        keep = np.append(self.ends_ms[1:] != self.ends_ms[:-1], True)
        return _Busy(self.ends_ms[keep], self.packets[keep])

    def gridded(self, cell_ms: int) -> _Busy:
        """In cells of that length."""
        return _Busy(-(-self.ends_ms // cell_ms) * cell_ms, self.packets).last_of_each()


class _KnotBuilder:
    """Turns packet times, given in pieces, into at most MAX_KNOTS knots of the capacity."""

    def __init__(self) -> None:
        self.packets = 0
        self.cell_ms = 1
        self._pieces: list[_Busy] = []
        self._knots = 1
        self._last_ms = 0

    def add(self, stamp_ms: Int64Array) -> None:
        """Packets at `stamp_ms` (int64[n], n >= 1, in order and not before those of earlier calls)."""
        counts = np.arange(self.packets + 1, self.packets + stamp_ms.size + 1)
        self._append(_Busy(np.maximum(stamp_ms, 1), counts).gridded(self.cell_ms))
        self.packets += stamp_ms.size
        self._last_ms = int(stamp_ms[-1])
        while self._knots > MAX_KNOTS:
            self._coarsen()

    def _append(self, piece: _Busy) -> None:
        if self._pieces and self._pieces[-1].ends_ms[-1] == piece.ends_ms[0]:
            # The piece before ended amid a cell; that cell's packets are counted in this one.
            before = self._pieces.pop()
            self._knots -= self._count(before, self._end_before(len(self._pieces)))
            before = _Busy(before.ends_ms[:-1], before.packets[:-1])
            if before.ends_ms.size:
                self._append(before)
        self._knots += self._count(piece, self._end_before(len(self._pieces)))
        self._pieces.append(piece)

    def _coarsen(self) -> None:
        """Take cells of twice the length: half the knots, unless packets are few and far between."""
        self.cell_ms *= 2
        pieces, self._pieces, self._knots = self._pieces, [], 1
        for piece in pieces:
            self._append(piece.gridded(self.cell_ms))

    def _end_before(self, k: int) -> int:
        return int(self._pieces[k - 1].ends_ms[-1]) if k else 0

    def _flat(self, piece: _Busy, end_before: int) -> npt.NDArray[np.bool_]:
        """Whether nothing crosses right before each cell: a flat stretch needs a knot of its own where it ends."""
        return np.diff(piece.ends_ms, prepend=end_before) > self.cell_ms

    def _count(self, piece: _Busy, end_before: int) -> int:
        return piece.ends_ms.size + int(np.count_nonzero(self._flat(piece, end_before)))

    def finish(self) -> Knots:
        """All knots; read-only, so that `Trace` takes them without a copy."""
        time_us, cumulative = np.zeros(self._knots, np.int64), np.zeros(self._knots, np.int64)
        filled, end_before, packets_before = 1, 0, 0
        self._pieces.reverse()
        while self._pieces:
            piece = self._pieces.pop()  # and let go at once: a long trace's pieces weigh as much as its arrays
            flat = self._flat(piece, end_before)
            place = filled + np.cumsum(flat) + np.arange(flat.size)
            time_us[place], cumulative[place] = piece.ends_ms * 1000, piece.packets * PACKET_BYTES
            time_us[place[flat] - 1] = (piece.ends_ms[flat] - self.cell_ms) * 1000
            cumulative[place[flat] - 1] = np.append(packets_before, piece.packets[:-1])[flat] * PACKET_BYTES
            filled, end_before, packets_before = int(place[-1]) + 1, int(piece.ends_ms[-1]), int(piece.packets[-1])
        # The last cell may reach beyond the last packet, but the trace must not.
        time_us[-1] = max(self._last_ms, 1) * 1000
        for array in (time_us, cumulative):
            array.flags.writeable = False
        return Knots(time_us, cumulative, f"a knot every {self.cell_ms} ms" if self.cell_ms > 1 else "")


def _fast_values(block: bytes, last_ms: int) -> Int64Array | None:
    """The numbers of a block of whole lines, or None where it holds anything but digits, line ends and order.

    Lines of one width are a rectangle of characters, read a column at a time.
    """
    text = np.frombuffer(block.replace(b"\r\n", b"\n"), np.uint8)
    ends = np.flatnonzero(text == _NEWLINE)
    widths = np.diff(ends, prepend=-1) - 1
    changes = np.flatnonzero(np.diff(widths)) + 1
    if changes.size >= _MAX_RUNS or widths.min() < 1 or widths.max() > _MAX_DIGITS:
        return None
    values = np.empty(ends.size, np.int64)
    start = 0
    for low, high in zip([0, *changes.tolist()], [*changes.tolist(), ends.size], strict=True):
        width = int(widths[low])
        stop = start + (high - low) * (width + 1)
        if not _read_columns(text[start:stop].reshape(-1, width + 1)[:, :width], values[low:high]):
            return None
        start = stop
    in_order = values[0] >= last_ms and bool((values[1:] >= values[:-1]).all())
    return values if in_order and values[-1] <= MAX_STAMP_MS else None


def _read_columns(characters: npt.NDArray[np.uint8], out: Int64Array) -> bool:
    """Write the numbers of uint8[n, width] into int64[n]; False where a character is no digit."""
    out[:] = 0
    for column in characters.T:
        digit = column - np.uint8(_ZERO)  # a character below "0" wraps round to a large number
        if digit.max() > 9:
            return False
        np.multiply(out, 10, out=out)
        np.add(out, digit, out=out)
    return True


def _slow_values(path: StrPath, block: bytes, lines_before: int, last_ms: int) -> Int64Array:
    """As `_fast_values`, line by line: takes blanks and foreign line ends, names the line that is wrong."""
    values: list[int] = []
    for number, raw in enumerate(block.split(b"\n")[:-1], start=lines_before + 1):
        line = Line(path, number, decoded(path, number, raw).strip())
        if len(line.text) > MAX_LINE_CHARACTERS:
            raise line.error(line.text, f"must be at most {MAX_LINE_CHARACTERS} characters")
        if not line.text:
            continue
        (text,) = line.columns(1)
        value = line.whole("time in ms", text, MAX_STAMP_MS)
        if value < last_ms:
            raise line.error(value, f"must not be before the line above ({last_ms})", "time in ms")
        values.append(value)
        last_ms = value
    return np.array(values, np.int64)
