"""Mahimahi packet-delivery traces: one whole number of ms a line, each a chance for one 1500-byte packet.

Format: the README of mahimahi's `traces/`, and `src/frontend/link_queue.cc` (R. Netravali et al., "Mahimahi",
USENIX ATC 2015). A repeated number is more than one packet in that ms. After the last line the trace begins
again, shifted by the last line's time.

How opportunities become capacity: the packets of ms m have crossed *at* m, so their bytes accrue at an even
rate during the ms that ends there, (m - 1, m]. Ms 0 has none before it; its packets accrue together with
those of ms 1. So the total is exactly 1500 bytes a line, no packet is through before its time, it lasts
as long as the last line says, and a file with the single line "1" is a steady 12 Mbit/s, as in mahimahi.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np
import numpy.typing as npt

from bufgym.errors import TraceError, where
from bufgym.traces.files import MAX_LINE_CHARACTERS, Line, StrPath, TextFile
from bufgym.traces.trace import MAX_DURATION_S, Int64Array

PACKET_BYTES: Final = 1500
MAX_STAMP_MS: Final = MAX_DURATION_S * 1000

_CHUNK_BYTES: Final = 4 * 2**20
_NEWLINE: Final = 10
_ZERO: Final = 48
_MAX_DIGITS: Final = len(str(MAX_STAMP_MS))
# Times in order have ever more digits, so a chunk holds few runs of equal width.
_MAX_RUNS: Final = 32


def read_mahimahi(path: StrPath) -> tuple[Int64Array, Int64Array]:
    """Knots of the capacity: int64[K] microseconds and int64[K] bytes, both from 0.

    The result takes 32 bytes a distinct ms at most, reading about twice that.

    Raises:
        TraceError: a line that is not a whole number from 0 to 10**10, a time before that of the line above,
            no line at all, or none after ms 0 (such a trace would have no duration).
    """
    knots = _KnotBuilder()
    last_ms, lines_before = 0, 0
    for block in _blocks(path):
        values = _fast_values(block, last_ms)
        if values is None:
            values = _slow_values(path, block, lines_before, last_ms)
        if values.size:
            knots.add(values)
            last_ms = int(values[-1])
        lines_before += block.count(b"\n")
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


class _KnotBuilder:
    """Turns packet times, given in pieces, into knots of the capacity."""

    def __init__(self) -> None:
        self.packets = 0
        self._time_us = [np.zeros(1, np.int64)]
        self._bytes = [np.zeros(1, np.int64)]

    def add(self, stamp_ms: Int64Array) -> None:
        """Packets at `stamp_ms` (int64[n], n >= 1, in order and not before those of earlier calls)."""
        ends_ms = np.maximum(stamp_ms, 1)
        last_of_ms = np.append(np.flatnonzero(ends_ms[1:] != ends_ms[:-1]), ends_ms.size - 1)
        ends_ms = ends_ms[last_of_ms]
        crossed = (self.packets + last_of_ms + 1) * PACKET_BYTES
        if int(self._time_us[-1][-1]) == ends_ms[0] * 1000:
            # The piece before ended amid a ms; its last knot is put right here.
            self._bytes[-1][-1] = crossed[0]
            ends_ms, crossed = ends_ms[1:], crossed[1:]
        self.packets += stamp_ms.size
        if ends_ms.size == 0:
            return
        # A flat stretch needs a knot of its own at (end - 1 ms), unless the ms before has packets too.
        previous_ms = np.append(int(self._time_us[-1][-1]) // 1000, ends_ms[:-1])
        previous_bytes = np.append(int(self._bytes[-1][-1]), crossed[:-1])
        flat = ends_ms - 1 > previous_ms
        place = np.cumsum(flat) + np.arange(ends_ms.size)
        time_us, cumulative = np.empty((2, int(place[-1]) + 1), np.int64)
        time_us[place], cumulative[place] = ends_ms * 1000, crossed
        time_us[place[flat] - 1] = (ends_ms[flat] - 1) * 1000
        cumulative[place[flat] - 1] = previous_bytes[flat]
        self._time_us.append(time_us)
        self._bytes.append(cumulative)

    def finish(self) -> tuple[Int64Array, Int64Array]:
        """All knots; read-only, so that `Trace` takes them without a copy."""
        time_us = np.concatenate(self._time_us)
        self._time_us.clear()  # at once, for a long trace's pieces weigh as much as its arrays
        cumulative = np.concatenate(self._bytes)
        self._bytes.clear()
        for array in (time_us, cumulative):
            array.flags.writeable = False
        return time_us, cumulative


def _fast_values(block: bytes, last_ms: int) -> Int64Array | None:
    """The numbers of a block of whole lines, or None where it holds anything but digits, line ends and order.

    Lines of one width are a rectangle of characters, read a column at a time.
    """
    text = np.frombuffer(block, np.uint8)
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
        try:
            line = Line(path, number, raw.decode("utf-8").strip())
        except UnicodeDecodeError as error:
            rule = f"must be UTF-8 text (byte {error.start + 1} is not)"
            raise TraceError(where(path, number, raw[:60], rule)) from error
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
