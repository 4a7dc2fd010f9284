"""Reader of lists of speed tests: several runs in a file.

Checked on M. Ghoshal et al., "An In-Depth Study of Uplink Performance of 5G mmWave Networks", 5G-MeMU 2022.
"""

import re
from collections.abc import Iterator
from typing import Final

from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.intervals import MAX_MBIT_PER_S, Knots, Rate, held_rates
from bufgym.traces.formats.text import Line, open_text, split_cells
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S

MAX_RUNS: Final = 16
RUNS: Final = tuple(f"run {number}" for number in range(1, MAX_RUNS + 1))  # Values of `column`

RUN_STEP_S: Final = 0.1  # Time between the samples of a run without times, s; runs with times have this step

RUN: Final = re.compile(r"Run ([0-9]{1,3})")
RULER: Final = re.compile(r"#{3,}")


def read_runs(path: StrPath, column: str = RUNS[0]) -> Knots:
    """One run of a file that has several: under its heading `Run N` a line of Mbit/s, or first one of times in s.

    Lines hold a whole run, so the file is read at once. Without times the samples are `RUN_STEP_S` apart. Where a run
    has further pairs of lines, of another network at the same time, the first is read; the note counts them.
    """
    runs = runs_of(path)
    if column not in runs:
        raise fault(path, f"has no {column}: must be one of {', '.join(runs) or 'none'}")
    lines = runs[column]
    if not lines:
        raise fault(path, f"{column} must have a line of Mbit/s")
    if len(lines) > 1 and len(lines) % 2:
        raise lines[-1].error(None, f"{column} must have one line, or pairs of them: times in s, Mbit/s")
    rates = lines[min(1, len(lines) - 1)]
    cells = split_cells(rates.text)
    times = split_cells(lines[0].text) if len(lines) > 1 else [f"{RUN_STEP_S * k:.1f}" for k in range(len(cells))]
    if len(times) != len(cells):
        raise rates.error(len(cells), f"must be as many as times in the line above ({len(times)})", "samples")
    steps = "times as stated" if len(lines) > 1 else f"a sample each {RUN_STEP_S:g} s"
    note = f"{column} of {len(runs)}, {steps}" + (f", the first of {len(lines) // 2} pairs" if len(lines) > 2 else "")
    knots = held_rates(path, _rates(lines[0], times, rates, cells))
    return knots._replace(note=", ".join(filter(None, (note, knots.note))))


def runs_of(path: StrPath) -> dict[str, list[Line]]:
    """The runs of a file with their lines, in its order; their numbers may have another."""
    with open_text(path) as file:
        text = file.text()
    runs: dict[str, list[Line]] = {}
    for number, content in enumerate(text.split("\n"), 1):
        line = Line(path, number, content.strip())
        match = RUN.fullmatch(line.text)
        if match is not None:
            name = f"run {int(match[1])}"
            if name not in RUNS or name in runs:
                raise line.error(match[1], f"must be from 1 to {MAX_RUNS}, and no run's above", "Run")
            runs[name] = []
        elif line.text and not RULER.fullmatch(line.text):
            if not runs:
                raise line.error(line.text, "must come under a heading, Run 1")
            runs[next(reversed(runs))].append(line)
    return runs


def _rates(timed: Line, times: list[str], line: Line, cells: list[str]) -> Iterator[Rate]:
    for time, cell in zip(times, cells, strict=True):
        start_us = round(timed.decimal("time in s", time, 0, MAX_DURATION_S) * US_PER_S)
        yield Rate(line, time, start_us, line.decimal("Mbit/s", cell, 0, MAX_MBIT_PER_S) * 0.125)
