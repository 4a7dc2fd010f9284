"""Bandwidth traces into files."""

from __future__ import annotations

import numpy as np

from bufgym.errors import TraceError, where
from bufgym.traces.files import StrPath
from bufgym.traces.readers import CSV_HEADER, MAX_INTERVAL_BYTES
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S, Trace


def write_csv(trace: Trace, path: StrPath) -> None:
    """Write the `csv` format, one line a segment; `read_trace` gives back the same knots, exactly.

    Raises:
        TraceError: the file cannot be written, or the trace is beyond what the reader takes (10**12 bytes in
            a segment, 10**7 s).
    """
    segment_bytes = np.diff(trace.cumulative_bytes)
    if segment_bytes.max() > MAX_INTERVAL_BYTES or trace.duration_us > MAX_DURATION_S * US_PER_S:
        rule = f"a segment must hold at most {MAX_INTERVAL_BYTES} bytes, the trace {MAX_DURATION_S} s"
        raise TraceError(where(path, None, None, f"cannot be written: {rule}"))
    ends_us, lengths_us = trace.time_us[1:].tolist(), np.diff(trace.time_us).tolist()
    try:
        with open(path, "w", encoding="ascii", newline="\n") as file:
            file.write(CSV_HEADER + "\n")
            for end_us, count, length_us in zip(ends_us, segment_bytes.tolist(), lengths_us, strict=True):
                file.write(f"{_milliseconds(end_us)},{count},{_milliseconds(length_us)}\n")
    except OSError as error:
        raise TraceError(where(path, None, None, f"cannot be written: {error.strerror or error}")) from error


def _milliseconds(time_us: int) -> str:
    """Microseconds as ms without needless decimals: 840000 is "840", 840500 is "840.5"."""
    whole, rest = divmod(time_us, 1000)
    return f"{whole}.{rest:03d}".rstrip("0") if rest else f"{whole}"
