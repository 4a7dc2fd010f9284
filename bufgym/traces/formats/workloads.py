"""Workloads in CSV files.

A file begins with the header ``time_s,bytes``, then optionally ``,topic`` and ``,x``; one message a line, in order of
arrival. Times are in s (whole microseconds count), and x is how far the scene has moved on (see `motion.py`).
"""

from array import array
from typing import Final

import numpy as np

from bufgym.traces import plausible
from bufgym.traces.formats.faults import StrPath, fault, heard
from bufgym.traces.formats.links import trace_name
from bufgym.traces.formats.motions import coordinate
from bufgym.traces.formats.recipes import field_of, unit_named
from bufgym.traces.formats.rows import check_order
from bufgym.traces.formats.tables import date_us
from bufgym.traces.formats.text import open_text, split_cells, write_text
from bufgym.traces.formats.trajectories import time_in_us
from bufgym.traces.sheet import Sheet, time_facts
from bufgym.traces.trace import US_PER_S
from bufgym.traces.workload import MAX_MESSAGE_BYTES, Workload
from bufgym.utils.errors import BufgymError

WORKLOAD_HEADERS: Final = ("time_s,bytes", "time_s,bytes,topic", "time_s,bytes,x", "time_s,bytes,topic,x")


def read_workload_csv(path: StrPath) -> Workload:
    """Read `time_s,bytes[,topic][,x]`, plain or packed; the first time and the first x become 0.

    A header of another tool may name a time, bytes and a topic among other columns, as `frame.time_epoch,frame.len`.
    """
    with open_text(path) as file:
        header, lines = file.below_header("the header time_s,bytes[,topic][,x], or name a time and bytes", _fields)
        titles, unit, whole = _fields(header), _unit(header), True
        times, sizes, numbers, xs = array("q"), array("q"), array("q"), array("d")
        topics: dict[str, int] = {}
        for line in lines:
            cells = dict(zip(titles, line.columns(len(titles), ","), strict=True))
            time, date = cells["time_s"], date_us(cells["time_s"])
            time_us = time_in_us(line, time, unit) if date is None else date
            whole = whole and time.isdigit()
            check_order(line, "time_s", time, time_us, times)
            times.append(time_us)
            sizes.append(line.whole("bytes", cells["bytes"], MAX_MESSAGE_BYTES))
            if not sizes[-1]:
                raise line.error(cells["bytes"], "must be at least 1", "bytes")
            name = cells.get("topic", "")
            if "topic" in cells and not name:
                raise line.error(name, "must not be empty", "topic")
            numbers.append(topics.setdefault(name, len(topics)))
            if "x" in cells:
                xs.append(coordinate(line, "x", cells["x"], xs[-1] if xs else 0.0))
    if not times:
        raise fault(path, "holds no message: must hold at least one")
    with heard() as doubts:
        if unit == "s" and whole:
            plausible.check_seconds(path, np.asarray(times) / US_PER_S, refuse_ms=True)
        plausible.warn_of_pauses(path, np.asarray(times) - times[0])
    arrival_us, size, number = (np.array(column, np.int64) for column in (times, sizes, numbers))
    x_from_0 = np.array(xs, np.float64) - xs[0] if xs else None
    source = f"{path} ({','.join(split_cells(header))})"
    sheet = Sheet(time_facts("messages", arrival_us - times[0], times[0]), tuple(doubts))
    return Workload(trace_name(path), arrival_us - times[0], size, number, tuple(topics), x_from_0, source, sheet=sheet)


def _fields(header: str) -> list[str]:
    """What each column of a header holds, by names that other tools use too; empty without a time and bytes."""
    names = split_cells(header)
    fields = [{"time": "time_s"}.get(field_of(name), field_of(name)) for name in names]
    if ",".join((fields[0], *names[1:])) in WORKLOAD_HEADERS:
        return [fields[0], *names[1:]]
    fields = [field if field in ("time_s", "bytes", "topic") else str(k) for k, field in enumerate(fields)]
    return fields if [fields.count(field) for field in ("time_s", "bytes")] == [1, 1] else []


def _unit(header: str) -> str:
    """The unit of the times, as their name says, else s."""
    return unit_named(split_cells(header)[_fields(header).index("time_s")]) or "s"


def write_workload_csv(workload: Workload, path: StrPath) -> None:
    """Write `time_s,bytes[,topic][,x]`; `read_workload_csv` gives back the same messages, bit for bit.

    A single topic without a name has no column, nor has an unknown x. Commas and outer blanks in names are refused.
    """
    for name in workload.topics:
        if workload.topics != ("",) and (not name or name != name.strip() or "," in name or not name.isprintable()):
            raise BufgymError(f"topic {name!r}: a name in a CSV file must be printable, without commas, and not empty")
    columns = {"time_s": [f"{t // US_PER_S}.{t % US_PER_S:06d}" for t in workload.arrival_us.tolist()]}
    columns["bytes"] = list(map(str, workload.size_bytes.tolist()))
    if workload.topics != ("",):
        columns["topic"] = [workload.topics[k] for k in workload.topic.tolist()]
    if workload.x is not None:
        columns["x"] = list(map(repr, workload.x.tolist()))
    write_text(path, (",".join(row) + "\n" for row in [columns, *zip(*columns.values(), strict=True)]))
