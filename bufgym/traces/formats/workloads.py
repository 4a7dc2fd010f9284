"""Workloads in CSV files.

A file begins with the header ``time_s,bytes``, then optionally ``,topic`` and ``,x``; one message a line, in order of
arrival. Times are in s (whole microseconds count), and x is how far the scene has moved on (see `motion.py`).
"""

from array import array
from itertools import chain
from typing import Final

import numpy as np

from bufgym.traces import plausible
from bufgym.traces.formats.faults import StrPath, fault, heard
from bufgym.traces.formats.links import trace_name
from bufgym.traces.formats.motions import coordinate
from bufgym.traces.formats.recipes import field_of
from bufgym.traces.formats.rows import check_order
from bufgym.traces.formats.tables import Columns, date_us, table_cells, time_unit
from bufgym.traces.formats.text import open_text, split_cells, write_text
from bufgym.traces.formats.trajectories import time_in_us
from bufgym.traces.sheet import Sheet, time_facts
from bufgym.traces.trace import US_PER_S
from bufgym.traces.workload import MAX_MESSAGE_BYTES, Workload
from bufgym.utils.errors import BufgymError

WORKLOAD_HEADERS: Final = ("time_s,bytes", "time_s,bytes,topic", "time_s,bytes,x", "time_s,bytes,topic,x")
_HEADER: Final = "the header time_s,bytes[,topic][,x], or name a time and bytes (or say --columns TIME BYTES)"


def read_workload_csv(path: StrPath, columns: Columns | None = None) -> Workload:
    """Read `time_s,bytes[,topic][,x]`, plain or packed; the first time and the first x become 0.

    A header of another tool may name a time, bytes and a topic among other columns, as `frame.time_epoch,frame.len`.
    Of any other table, ``columns`` says which they are.
    """
    times, sizes, numbers, xs = array("q"), array("q"), array("q"), array("d")
    topics, whole = dict[str, int](), True
    with open_text(path) as file:
        first, lines = file.below_header(_HEADER, _fields if columns is None else bool)
        wanted = _fields(first.text) if columns is None else columns.named("time", "bytes", "topic")
        for line, cells, names in table_cells(chain([first], lines), list(wanted.values())):
            texts = dict(zip(wanted, cells, strict=True))
            time, date = texts["time"], date_us(texts["time"])
            unit = time_unit(columns, names[0])
            time_us = time_in_us(line, time, unit or "s") if date is None else date
            whole = whole and time.isdigit() and unit in ("", "s")
            check_order(line, "time_s", time, time_us, times)
            times.append(time_us)
            sizes.append(line.whole("bytes", texts["bytes"], MAX_MESSAGE_BYTES))
            if not sizes[-1]:
                raise line.error(texts["bytes"], "must be at least 1", "bytes")
            name = texts.get("topic", "")
            if "topic" in texts and not name:
                raise line.error(name, "must not be empty", "topic")
            numbers.append(topics.setdefault(name, len(topics)))
            if "x" in texts:
                xs.append(coordinate(line, "x", texts["x"], xs[-1] if xs else 0.0))
    if not times:
        raise fault(path, "holds no message: must hold at least one")
    arrival_us, size, number = (np.array(column, np.int64) for column in (times, sizes, numbers))
    with heard() as doubts:
        if whole:
            plausible.check_seconds(path, np.asarray(times) / US_PER_S, refuse_ms=True)
        plausible.warn_of_pauses(path, arrival_us - times[0], number, list(topics))
    x_from_0 = np.array(xs, np.float64) - xs[0] if xs else None
    source = f"{path} ({','.join(wanted.values() if columns else split_cells(first.text))})"
    sheet = Sheet(time_facts("messages", arrival_us - times[0], times[0]), tuple(doubts))
    return Workload(trace_name(path), arrival_us - times[0], size, number, tuple(topics), x_from_0, source, sheet=sheet)


def _fields(header: str) -> dict[str, str]:
    """The column of each field, by names that other tools use too; none without one time and one of bytes."""
    names = split_cells(header)
    fields = [field_of(name) for name in names]
    if fields[0] == "time" and ",".join(("time_s", *names[1:])) in WORKLOAD_HEADERS:
        return {"time": names[0], **{name: name for name in names[1:]}}
    if [fields.count(field) for field in ("time", "bytes")] != [1, 1]:
        return {}
    return {field: names[fields.index(field)] for field in ("time", "bytes", "topic") if field in fields}


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
