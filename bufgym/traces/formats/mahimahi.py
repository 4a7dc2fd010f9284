"""Mahimahi packet-delivery traces: a whole number of ms a line, each an opportunity to deliver one 1500-byte packet.

Format: the README of mahimahi's `traces/`, and `src/frontend/link_queue.cc` [netravali2015mahimahi]. A repeated number
means several packets in that ms. After the last line the trace begins again, shifted by the last line's time.

The packets of ms m are through *at* m, so their bytes accrue at an even rate during the ms that ends there, (m - 1, m].
Ms 0 has no ms before it, so its packets accrue together with those in ms 1. The total is then exactly 1500 bytes a
line, and no packet is through before its time. The trace lasts as long as its last line says. A file with the single
line "1" is a steady 12 Mbit/s, as in mahimahi.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.intervals import Knots
from bufgym.traces.formats.text import MAX_LINE_CHARACTERS, MAX_LINES, open_text, parsed_line
from bufgym.traces.trace import MAX_DURATION_S, Int64Array

PACKET_BYTES: Final = 1500
MAX_STAMP_MS: Final = MAX_DURATION_S * 1000

# 384 MB as arrays; seven hours of a link with packets in every ms.
MAX_TIMES: Final = 24_000_000

_CHUNK_BYTES: Final = 4 * 2**20


def read_mahimahi(path: StrPath) -> Knots:
    """Knots of the capacity.

    Raises:
        TraceError: a line that is not a whole number from 0 to 10**10, a time before that of the line above,
            no line at all, none after ms 0 (such a trace would have no duration), or over MAX_TIMES different times.
    """
    pieces: list[tuple[Int64Array, Int64Array]] = []
    last_ms = lines_before = odd_lines = times = 0
    for block in _blocks(path):
        stamps_ms, lines = _parsed_at_once(block, last_ms), block.count(b"\n")
        if stamps_ms is None:
            odd_lines += lines
            if odd_lines > MAX_LINES:
                rule = f"more than {MAX_LINES} lines so far in blocks that are not all bare numbers: must be fewer"
                raise fault(path, rule, line=lines_before + 1)
            stamps_ms = _parsed_by_line(path, block, lines_before, last_ms)
        if stamps_ms.size:
            pieces.append(np.unique(np.maximum(stamps_ms, 1), return_counts=True))
            last_ms, times = int(stamps_ms[-1]), times + len(pieces[-1][0])
        lines_before += lines
        if times > MAX_TIMES:
            raise fault(path, f"more than {MAX_TIMES} different times: must be fewer", line=lines_before)
    if not pieces:
        raise fault(path, "is empty: must hold a line for each packet")
    if last_ms == 0:
        raise fault(path, "the last time must be after ms 0", line=lines_before, value=0, field="time in ms")
    ends_ms, packets = (np.concatenate(column) for column in zip(*pieces, strict=True))
    packets = np.cumsum(packets)
    is_last = np.append(ends_ms[1:] != ends_ms[:-1], True)  # a ms may continue in the next block
    return _knots(ends_ms[is_last], packets[is_last])


def _knots(ends_ms: Int64Array, packets: Int64Array) -> Knots:
    """The capacity, from the ms in which packets were delivered and all packets up to the end of each."""
    # A ms after a stretch without packets needs a knot of its own where it begins.
    after_gap = np.diff(ends_ms, prepend=0) > 1
    count = 1 + after_gap.size + int(np.count_nonzero(after_gap))
    time_us, cumulative = np.zeros(count, np.int64), np.zeros(count, np.int64)
    at_end = 1 + np.arange(after_gap.size) + np.cumsum(after_gap)
    time_us[at_end], cumulative[at_end] = ends_ms * 1000, packets * PACKET_BYTES
    at_start = at_end[after_gap] - 1
    time_us[at_start] = (ends_ms[after_gap] - 1) * 1000
    cumulative[at_start] = np.append(0, packets[:-1])[after_gap] * PACKET_BYTES
    for array in (time_us, cumulative):
        array.flags.writeable = False  # so that `Trace` takes them without a copy
    return Knots(time_us, cumulative)


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
