"""Workloads in CSV files.

A file begins with the header ``time_s,bytes``, then optionally ``,topic`` and ``,x``; one message a line, in order of
arrival. Times are in s (whole microseconds count), and x is how far the scene has moved on (see `motion.py`).
"""

from __future__ import annotations

from array import array
from typing import Final

import numpy as np

from bufgym.ground.errors import BufgymError
from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.links import trace_name
from bufgym.traces.formats.motions import MAX_COORDINATE
from bufgym.traces.formats.text import Line, open_text, split_cells, write_text
from bufgym.traces.formats.trajectories import seconds
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S
from bufgym.traces.workload import MAX_MESSAGE_BYTES, MAX_MESSAGES, Workload

WORKLOAD_HEADERS: Final = ("time_s,bytes", "time_s,bytes,topic", "time_s,bytes,x", "time_s,bytes,topic,x")


def read_workload_csv(path: StrPath) -> Workload:
    """Read `time_s,bytes[,topic][,x]`, plain or gzip'd; the first time and the first x become 0.

    Raises:
        TraceError: the file cannot be read, or a line breaks a rule: another header, times or x that decrease, sizes
            that are not whole numbers from 1 to 10**10, an empty topic, more than 10**7 messages. The message names
            the file, the line, the value and the rule.
    """
    with open_text(path) as file:
        lines = file.lines()
        header = next(lines, None)
        if header is None:
            raise fault(path, f"is empty: must begin with the header {WORKLOAD_HEADERS[0]}")
        titles = split_cells(header.text)
        if ",".join(titles) not in WORKLOAD_HEADERS:
            raise header.error(header.text, "must be the header time_s,bytes[,topic][,x]")
        times, sizes, numbers, xs = array("q"), array("q"), array("q"), array("d")
        topics: dict[str, int] = {}
        for line in lines:
            cells = dict(zip(titles, line.columns(len(titles), ","), strict=True))
            if len(times) >= MAX_MESSAGES:
                raise line.error(None, f"must be one of at most {MAX_MESSAGES} messages")
            time_us = seconds(line, cells["time_s"])
            if times and time_us < times[-1]:
                raise line.error(cells["time_s"], "must not be before the line above", "time_s")
            if times and time_us - times[0] > MAX_DURATION_S * US_PER_S:
                raise line.error(cells["time_s"], f"must be at most {MAX_DURATION_S} s after the first", "time_s")
            times.append(time_us)
            sizes.append(_size(line, cells["bytes"]))
            name = cells.get("topic", "")
            if "topic" in cells and not name:
                raise line.error(name, "must not be empty", "topic")
            numbers.append(topics.setdefault(name, len(topics)))
            if "x" in cells:
                x = line.decimal("x", cells["x"], 0, MAX_COORDINATE)
                if xs and x < xs[-1]:
                    raise line.error(cells["x"], f"must not be below the line above ({xs[-1]!r})", "x")
                xs.append(x)
    if not times:
        raise fault(path, "holds no message: must hold at least one")
    arrival_us, size, number = (np.array(column, np.int64) for column in (times, sizes, numbers))
    x_from_0 = np.array(xs, np.float64) - xs[0] if xs else None
    source = f"{path} ({','.join(titles)})"
    return Workload(trace_name(path), arrival_us - arrival_us[0], size, number, tuple(topics), x_from_0, source)


def _size(line: Line, text: str) -> int:
    size = line.whole("bytes", text, MAX_MESSAGE_BYTES)
    if size < 1:
        raise line.error(text, "must be at least 1", "bytes")
    return size


def write_workload_csv(workload: Workload, path: StrPath) -> None:
    """Write `time_s,bytes[,topic][,x]`; `read_workload_csv` gives back the same messages, bit for bit.

    The column topic is left out if the only topic has no name, and x if it is unknown. A name with a comma, or with
    blanks at its ends, is refused.
    """
    for name in workload.topics:
        if workload.topics != ("",) and (not name or name != name.strip() or "," in name or not name.isprintable()):
            raise BufgymError(f"topic {name!r}: a name in a CSV file must be printable, without commas, and not empty")
    assert workload.topic is not None
    columns = {"time_s": [f"{t // US_PER_S}.{t % US_PER_S:06d}" for t in workload.arrival_us.tolist()]}
    columns["bytes"] = list(map(str, workload.size_bytes.tolist()))
    if workload.topics != ("",):
        columns["topic"] = [workload.topics[k] for k in workload.topic.tolist()]
    if workload.x is not None:
        columns["x"] = list(map(repr, workload.x.tolist()))
    write_text(path, (",".join(row) + "\n" for row in [columns, *zip(*columns.values(), strict=True)]))
