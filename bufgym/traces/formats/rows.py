"""Samples of a text file, a line each, in order of time: read in blocks, so that a day of poses fits into memory.

A block of plain numbers is parsed at once. Any other, with remarks or with a line that breaks a rule, is parsed line by
line, which says what is wrong with which line. Both give the same numbers.
"""

from array import array
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

import numpy as np

from bufgym.traces.formats.faults import LeftOut, StrPath, fault, warn
from bufgym.traces.formats.text import Line, TextFile, open_text
from bufgym.traces.formats.units import LEAST_STEP_S, SLOW_STEP_S, steady_step
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S, Float64Array, Int64Array

RowReader = Callable[[Line, list[float] | None], tuple[str, int, list[float]] | None]
"""Parses a line, given the values of the previous one, into the time as it is written, the time in us, and values; None
for a line without a sample."""
BlockReader = Callable[[bytes, list[float] | None], "tuple[Int64Array, Float64Array] | None"]
"""Parses lines of plain numbers into times in us, int64[m], and values, float64[m, columns]; None for other lines."""

_COUNTED: Final = 1000  # Lines from one call of a progress bar to the next, at most


class Rows(NamedTuple):
    """The samples of a file."""

    time_us: Int64Array  # int64[n], microseconds from 0, increasing
    values: Float64Array  # float64[n, columns]
    note: str  # what was left out and is not worth a warning; empty for nothing
    start_us: int  # time 0 by the recording's clock, microseconds


def read_rows(
    path: StrPath,
    read_row: RowReader,
    skip: int = 0,
    *,
    read_block: BlockReader | None = None,
    what: str = "samples",
    advance: Callable[[int], object] = int,
) -> Rows:
    """The samples of the lines after number `skip`, called ``what``; ``advance`` is called with lines just read.

    If several lines have the same time, as in freiburg2_desk, the last counts, and what is left out is said.
    """
    kept = _Kept(path, what)
    with open_text(path) as file:
        for number, block in file.blocks():
            above = block.split(b"\n", max(0, skip + 1 - number))  # the lines to skip, then all others
            number, block = number + len(above) - 1, above[-1]
            lines = block.count(b"\n") + (not block.endswith(b"\n"))
            parsed = None if read_block is None else read_block(block, kept.previous)
            if parsed is None or len(parsed[0]) != lines or not kept.takes(parsed[0]):
                for numbers, time_us, values in _by_line(file, number, block, read_row, skip, kept, advance):
                    kept.add(numbers, time_us, values)
            else:
                kept.add(np.arange(number, number + lines), *parsed)
                advance(lines)
    return kept.rows()


def _by_line(
    file: TextFile,
    number: int,
    block: bytes,
    read_row: RowReader,
    skip: int,
    kept: "_Kept",
    advance: Callable[[int], object],
) -> Iterator[tuple[Int64Array, Int64Array, Float64Array]]:
    """Numbers, times and values of the lines of a block."""
    numbers, times, rows = array("q"), kept.edges(), list[list[float]]()
    before, previous = len(times), kept.previous
    for line in file.block_lines(number, block):
        if line.number <= skip or line.text.startswith("#"):
            continue
        if (sample := read_row(line, previous)) is None:
            continue
        text, time_us, row = sample
        check_order(line, "time in s", text, time_us, times)
        times.append(time_us)
        numbers.append(line.number)
        rows.append(row)
        previous = row
        if len(rows) % _COUNTED == 0:
            advance(_COUNTED)
    advance(len(rows) % _COUNTED)
    if rows:
        yield np.asarray(numbers, np.int64), np.asarray(times[before:], np.int64), np.array(rows, np.float64)


class _Kept:
    """The samples so far; of samples of one time the last."""

    def __init__(self, path: StrPath, what: str) -> None:
        self._path, self._what = path, what
        self._times, self._values, self._columns = array("q"), array("d"), 0
        self._left_out = LeftOut()

    @property
    def previous(self) -> list[float] | None:
        """Values of the last sample."""
        return self._values[-self._columns :].tolist() if self._times else None

    def edges(self) -> "array[int]":
        """First time and last, or none."""
        return array("q", [self._times[0], self._times[-1]] if self._times else [])

    def takes(self, time_us: Int64Array) -> bool:
        """Whether these times go on from those so far by the rules of ``check_order``."""
        first, last = (self._times[0], self._times[-1]) if self._times else (time_us[0], time_us[0])
        in_order = time_us[0] >= last and bool((time_us[1:] >= time_us[:-1]).all())
        return in_order and bool(time_us[-1] - first <= MAX_DURATION_S * US_PER_S)

    def add(self, numbers: Int64Array, time_us: Int64Array, values: Float64Array) -> None:
        """Add samples of these lines, whose times are in order."""
        self._columns = values.shape[1]
        self._left_out.add(time_us, numbers)
        if self._times and self._times[-1] == time_us[0]:
            self._times.pop()
            del self._values[-self._columns :]
        is_last = np.append(time_us[1:] != time_us[:-1], True)
        if not is_last.all():
            time_us, values = time_us[is_last], values[is_last]
        self._times.frombytes(time_us.tobytes())
        self._values.frombytes(values.tobytes())

    def rows(self) -> Rows:
        """All of them, checked."""
        left_out, what = self._left_out, self._what
        if len(self._times) == 1 and left_out.total > 1:
            rule = f"{left_out.total} {what} of one time: must have different times, written with all their digits"
            raise fault(self._path, rule, line=left_out.first)
        if len(self._times) < 2:
            raise fault(self._path, f"must hold at least 2 {what} of different times, has {len(self._times)}")
        time_us = np.frombuffer(self._times, np.int64)
        step_s = float(np.median(np.diff(time_us))) / US_PER_S
        if step_s < LEAST_STEP_S and steady_step(time_us) / US_PER_S < LEAST_STEP_S:
            rule = f"must be at least {LEAST_STEP_S:g} s (are the times in another unit?)"
            raise fault(self._path, rule, value=f"{step_s:g} s", field="median step of the times")
        if step_s > SLOW_STEP_S:
            warn(self._path, f"its {what} are {step_s:.6g} s apart (median): are the times in another unit?")
        note = left_out.said(self._path, what)
        values = np.frombuffer(self._values, np.float64).reshape(-1, self._columns)
        return Rows(time_us - time_us[0], values, note, int(time_us[0]))


def check_order(line: Line, field: str, text: str, time_us: int, times: Sequence[int]) -> None:
    """Check that a time, written as ``text``, is not before the latest of ``times``, nor too far from the first, us."""
    if times and time_us < times[-1]:
        raise line.error(text, f"must not be before the line above ({times[-1] / US_PER_S:.6f})", field)
    if times and time_us - times[0] > MAX_DURATION_S * US_PER_S:
        raise line.error(text, f"must be at most {MAX_DURATION_S} s after the first", field)
