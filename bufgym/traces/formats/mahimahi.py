"""Mahimahi packet-delivery traces: a whole number of ms a line, each an opportunity to deliver one 1500-byte packet.

Format: the README of mahimahi's `traces/`, and `src/frontend/link_queue.cc` [netravali2015mahimahi]. A repeated number
means several packets in that ms. After the last line the trace begins again, shifted by the last line's time.

The packets of ms m are through *at* m, so their bytes accrue at an even rate during the ms that ends there, (m - 1, m].
Ms 0 has no ms before it, so its packets accrue together with those in ms 1. The total is then exactly 1500 bytes a
line, and no packet is through before its time. The trace lasts as long as its last line says. A file with the single
line "1" is a steady 12 Mbit/s, as in mahimahi.
"""

from typing import Final

import numpy as np

from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.intervals import Knots
from bufgym.traces.formats.text import TextFile, open_text
from bufgym.traces.trace import MAX_DURATION_S, Int64Array

PACKET_BYTES: Final = 1500
MAX_STAMP_MS: Final = MAX_DURATION_S * 1000

# Text after decompression: 10**7 packets at any time, and more at early ones.
MAX_BYTES: Final = 2**27


def read_mahimahi(path: StrPath) -> Knots:
    """Knots of the capacity."""
    with open_text(path) as file:
        stamps_ms = _parsed_at_once(file.whole(MAX_BYTES))
    if stamps_ms is None:
        with open_text(path) as file:
            stamps_ms = _parsed_by_line(file)
    if stamps_ms.size and stamps_ms[-1] == 0:
        raise fault(path, "the last time must be after ms 0", value=0, field="time in ms")
    return packets_at(path, np.maximum(stamps_ms, 1))


def packets_at(path: StrPath, stamps_ms: Int64Array) -> Knots:
    """The capacity of packets at these times, from ms 1 on."""
    if not stamps_ms.size:
        raise fault(path, "is empty: must hold a line for each packet")
    is_last = np.append(stamps_ms[1:] != stamps_ms[:-1], True)
    return _knots(stamps_ms[is_last], np.flatnonzero(is_last) + 1)


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


def _parsed_at_once(text: bytes) -> Int64Array | None:
    """The numbers of all lines, or None where there is anything but digits, line ends and order."""
    text = text.replace(b"\r\n", b"\n")
    if not text or text.translate(None, b"0123456789\n"):
        return None
    stamps_ms: Int64Array = np.fromstring(text, np.int64, sep="\n")  # a number too large becomes 2**63 - 1
    if stamps_ms.size != text.count(b"\n") + (not text.endswith(b"\n")):  # blank lines
        return None
    in_order = bool((stamps_ms[1:] >= stamps_ms[:-1]).all())
    return stamps_ms if in_order and stamps_ms[-1] <= MAX_STAMP_MS else None


def _parsed_by_line(file: TextFile) -> Int64Array:
    """As `_parsed_at_once`, line by line: accepts blanks and foreign line ends, names the line that is wrong."""
    stamps_ms: list[int] = []
    for line in file.lines():
        (text,) = line.columns(1)
        stamp_ms = line.whole("time in ms", text, MAX_STAMP_MS)
        if stamps_ms and stamp_ms < stamps_ms[-1]:
            raise line.error(stamp_ms, f"must not be before the line above ({stamps_ms[-1]})", "time in ms")
        stamps_ms.append(stamp_ms)
    return np.array(stamps_ms, np.int64)
