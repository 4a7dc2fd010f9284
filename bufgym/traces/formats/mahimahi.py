"""Mahimahi packet-delivery traces: a whole number of ms a line, each an opportunity to deliver one 1500-byte packet.

Format: the README of mahimahi's `traces/`, and `src/frontend/link_queue.cc` [netravali2015mahimahi]. A repeated number
means several packets in that ms. After the last line the trace begins again, shifted by the last line's time.

The packets of ms m are through *at* m, so their bytes accrue at an even rate during the ms that ends there, (m - 1, m].
Ms 0 has no ms before it, so its packets accrue together with those in ms 1. The total is then exactly 1500 bytes a
line, and no packet is through before its time. The trace lasts as long as its last line says. A file with the single
line "1" is a steady 12 Mbit/s, as in mahimahi.

A gigabyte of lines can hold a hundred million distinct ms, more than should be held in memory. A trace of more than
MAX_KNOTS knots is therefore read in bins of 2 ms, 4 ms, ... by the same rule. The packets of a bin accrue evenly in it,
and the total and the duration stay exact. The trace's `source` states the bin.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.intervals import Knots
from bufgym.traces.formats.text import MAX_LINE_CHARACTERS, MAX_LINES, open_text, parsed_line
from bufgym.traces.trace import MAX_DURATION_S, Int64Array

PACKET_BYTES: Final = 1500
MAX_STAMP_MS: Final = MAX_DURATION_S * 1000

# 384 MB as arrays; seven hours of a link with packets in every ms.
MAX_KNOTS: Final = 24_000_000

_CHUNK_BYTES: Final = 4 * 2**20


def read_mahimahi(path: StrPath) -> Knots:
    """Knots of the capacity, at most MAX_KNOTS.

    The result takes at most 32 bytes a distinct ms, reading about twice as much.

    Raises:
        TraceError: a line that is not a whole number from 0 to 10**10, a time before that of the line above,
            no line at all, or none after ms 0 (such a trace would have no duration).
    """
    knots = _KnotBuilder()
    last_ms = lines_before = odd_lines = 0
    for block in _blocks(path):
        stamps_ms, lines = _parsed_at_once(block, last_ms), block.count(b"\n")
        if stamps_ms is None:
            odd_lines += lines
            if odd_lines > MAX_LINES:
                rule = f"more than {MAX_LINES} lines so far in blocks that are not all bare numbers: must be fewer"
                raise fault(path, rule, line=lines_before + 1)
            stamps_ms = _parsed_by_line(path, block, lines_before, last_ms)
        if stamps_ms.size:
            knots.add(stamps_ms)
            last_ms = int(stamps_ms[-1])
        lines_before += lines
    if not knots.packets:
        raise fault(path, "is empty: must hold a line for each packet")
    if last_ms == 0:
        raise fault(path, "the last time must be after ms 0", line=lines_before, value=0, field="time in ms")
    return knots.finish()


def _blocks(path: StrPath) -> Iterator[bytes]:
    """The file in pieces of whole lines, each with its line end."""
    carried, lines_before = b"", 0
    with open_text(path) as file:
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
                value = carried[:60].decode("latin-1")
                rule = f"must be at most {MAX_LINE_CHARACTERS} characters"
                raise fault(path, rule, line=lines_before + 1, value=value)
    if carried:
        yield carried + b"\n"


class _Bins(NamedTuple):
    """The bins of time in which packets were delivered: their ends, and all packets up to each end, int64[n] each."""

    ends_ms: Int64Array
    packets: Int64Array

    def of(self, bin_ms: int) -> _Bins:
        """The same in bins of that length; of entries with the same end the last counts the packets of all."""
        ends_ms = -(-self.ends_ms // bin_ms) * bin_ms
        is_last = np.append(ends_ms[1:] != ends_ms[:-1], True)
        return _Bins(ends_ms[is_last], self.packets[is_last])


class _KnotBuilder:
    """Turns packet times, given in pieces, into at most MAX_KNOTS knots of the capacity."""

    def __init__(self) -> None:
        self.packets = 0
        self._bin_ms = 1
        self._pieces: list[_Bins] = []
        self._last_ms = 0

    def add(self, stamps_ms: Int64Array) -> None:
        """Add packets at `stamps_ms` (int64[n], n >= 1, in order, and not before earlier packets)."""
        counts = np.arange(self.packets + 1, self.packets + stamps_ms.size + 1)
        self._pieces.append(_Bins(np.maximum(stamps_ms, 1), counts).of(self._bin_ms))
        self.packets += stamps_ms.size
        self._last_ms = int(stamps_ms[-1])
        # Neighbouring pieces share at most one bin, so there are at least so many bins, each with a knot.
        while sum(piece.ends_ms.size - 1 for piece in self._pieces) > MAX_KNOTS:
            self._bin_ms *= 2
            self._pieces = [self._joined()]

    def _joined(self) -> _Bins:
        """All pieces as one, in the present bins."""
        return _Bins(*(np.concatenate(column) for column in zip(*self._pieces, strict=True))).of(self._bin_ms)

    def finish(self) -> Knots:
        """All knots; read-only, so that `Trace` takes them without a copy."""
        bins = self._joined()
        self._pieces = []
        while True:
            # A bin after a stretch without packets needs a knot of its own where it begins.
            after_gap = np.diff(bins.ends_ms, prepend=0) > self._bin_ms
            count = 1 + after_gap.size + int(np.count_nonzero(after_gap))
            if count <= MAX_KNOTS:
                break
            self._bin_ms *= 2
            bins = bins.of(self._bin_ms)
        time_us, cumulative = np.zeros(count, np.int64), np.zeros(count, np.int64)
        at_end = 1 + np.arange(after_gap.size) + np.cumsum(after_gap)
        time_us[at_end], cumulative[at_end] = bins.ends_ms * 1000, bins.packets * PACKET_BYTES
        at_start = at_end[after_gap] - 1
        time_us[at_start] = (bins.ends_ms[after_gap] - self._bin_ms) * 1000
        cumulative[at_start] = np.append(0, bins.packets[:-1])[after_gap] * PACKET_BYTES
        # The last bin may reach beyond the last packet, but the trace must not.
        time_us[-1] = max(self._last_ms, 1) * 1000
        for array in (time_us, cumulative):
            array.flags.writeable = False
        return Knots(time_us, cumulative, f"a knot every {self._bin_ms} ms" if self._bin_ms > 1 else "")


def _parsed_at_once(block: bytes, last_ms: int) -> Int64Array | None:
    """The numbers of a block of whole lines, or None where it holds anything but digits, line ends and order."""
    text = block.replace(b"\r\n", b"\n")
    if text.translate(None, b"0123456789\n"):
        return None
    stamps_ms: Int64Array = np.fromstring(text, np.int64, sep="\n")  # a number too large becomes 2**63 - 1
    if stamps_ms.size != text.count(b"\n"):  # blank lines
        return None
    in_order = stamps_ms[0] >= last_ms and bool((stamps_ms[1:] >= stamps_ms[:-1]).all())
    return stamps_ms if in_order and stamps_ms[-1] <= MAX_STAMP_MS else None


def _parsed_by_line(path: StrPath, block: bytes, lines_before: int, last_ms: int) -> Int64Array:
    """As `_parsed_at_once`, line by line: accepts blanks and foreign line ends, names the line that is wrong."""
    stamps_ms: list[int] = []
    for number, raw in enumerate(block.split(b"\n")[:-1], start=lines_before + 1):
        line = parsed_line(path, number, raw)
        if not line.text:
            continue
        (text,) = line.columns(1)
        stamp_ms = line.whole("time in ms", text, MAX_STAMP_MS)
        if stamp_ms < last_ms:
            raise line.error(stamp_ms, f"must not be before the line above ({last_ms})", "time in ms")
        stamps_ms.append(stamp_ms)
        last_ms = stamp_ms
    return np.array(stamps_ms, np.int64)
