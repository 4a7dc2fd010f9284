"""Bandwidth traces into files, and how much a copy differs from its original.

`write_csv` is exact. A Mahimahi file holds packets of 1500 bytes at whole ms; `difference` says what others lose.
"""

from collections.abc import Callable
from typing import Final

import numpy as np

from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.intervals import MAX_INTERVAL_BYTES
from bufgym.traces.formats.mahimahi import PACKET_BYTES
from bufgym.traces.formats.text import decimals, write_text
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S, Int64Array, Trace

CSV_HEADER: Final = "t_ms,bytes,interval_ms"
# Lines of at most 11 digits, as many as fit into the reader's 128 MiB.
MAX_PACKETS: Final = 10**7


def write_csv(trace: Trace, path: StrPath) -> None:
    """Write the `csv` format, one line a segment; `read_trace` gives back the same knots, exactly."""
    segment_bytes = np.diff(trace.cumulative_bytes)
    if segment_bytes.max() > MAX_INTERVAL_BYTES or trace.duration_us > MAX_DURATION_S * US_PER_S:
        rule = f"a segment must hold at most {MAX_INTERVAL_BYTES} bytes, the trace {MAX_DURATION_S} s"
        raise fault(path, f"cannot be written: {rule}")
    ends_us, lengths_us = trace.time_us[1:].tolist(), np.diff(trace.time_us).tolist()
    lines = (
        f"{decimals(end_us, 3)},{count},{decimals(length_us, 3)}\n"
        for end_us, count, length_us in zip(ends_us, segment_bytes.tolist(), lengths_us, strict=True)
    )
    write_text(path, [CSV_HEADER + "\n"], lines)


def write_mahimahi(trace: Trace, path: StrPath) -> None:
    """Write the `mahimahi` format: a line for each packet, at the first whole ms by which its 1500 bytes are through.

    So no packet is ahead of the trace, and none is late by more than the rest of its ms. The last line says how
    long the trace lasts, so there is a packet at the end (the next whole ms) even if not all its bytes are through by
    then. A trace that came from Mahimahi is preserved exactly (its packets of ms 0 as packets of ms 1).
    """
    packets = trace.total_bytes // PACKET_BYTES
    if packets > MAX_PACKETS or trace.duration_us > MAX_DURATION_S * US_PER_S:
        rule = f"the trace must last at most {MAX_DURATION_S} s and hold at most {MAX_PACKETS} packets"
        raise fault(path, f"cannot be written: {rule}")
    write_text(path, (f"{stamp}\n" for stamp in _stamps(trace, packets)))


WRITERS: Final[dict[str, Callable[[Trace, StrPath], None]]] = {"csv": write_csv, "mahimahi": write_mahimahi}


def difference(trace: Trace, copy: Trace) -> str:
    """How far `copy` is from `trace` in all, and at any one time up to the end of the shorter one, in words.

    Between knots both are straight lines, so they are farthest apart at a knot of one of them.
    """
    largest_bytes = 0.0
    for times in (trace.time_us, copy.time_us):
        inside = times[times <= min(trace.duration_us, copy.duration_us)]
        original, copied = (np.interp(inside, link.time_us, link.cumulative_bytes) for link in (trace, copy))
        largest_bytes = max(largest_bytes, float(np.abs(original - copied).max()))
    bytes_more, us_more = copy.total_bytes - trace.total_bytes, copy.duration_us - trace.duration_us
    if not (largest_bytes or bytes_more or us_more):
        return "nothing lost"
    lost = f"total {bytes_more:+d} bytes, at most {largest_bytes:.6g} bytes off at any time"
    return f"{lost}, duration {us_more / 1000:+g} ms" if us_more else lost


def _stamps(trace: Trace, packets: int) -> list[int]:
    """The ms of all packets that are through by the end, and of one more if the last is through before the end."""
    end_ms = -(-trace.duration_us // 1000)
    due = np.arange(1, packets + 1, dtype=np.int64) * PACKET_BYTES
    stamps_ms: list[int] = (-(-_transmitted_us(trace, due) // 1000)).tolist()
    return stamps_ms if packets and stamps_ms[-1] == end_ms else [*stamps_ms, end_ms]


def _transmitted_us(trace: Trace, due: Int64Array) -> Int64Array:
    """When so many bytes (int64[n], each from 1 to the total) are through: int64[n] microseconds, rounded up."""
    time_us, cumulative = trace.time_us, trace.cumulative_bytes
    k = np.searchsorted(cumulative, due, side="left")
    within, length_us = due - cumulative[k - 1], time_us[k] - time_us[k - 1]
    # The product is at most (bytes x microseconds) of a segment, which a Trace keeps below 2**62.
    return np.asarray(time_us[k - 1] - (-within * length_us) // (cumulative[k] - cumulative[k - 1]), np.int64)
