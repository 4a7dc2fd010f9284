"""Readers of speed tests: logs of nuttcp, and lists of runs. `iperf3` reads the JSON of iperf3.

Sources of the recordings that they were checked on: M. Ghoshal et al., "A First Large-Scale Study of Operational 5G
Standalone Networks", CoNEXT 2025 (nuttcp); M. Ghoshal et al., "An In-Depth Study of Uplink Performance of 5G mmWave
Networks", 5G-MeMU 2022 (lists).
"""

import re
from collections.abc import Iterator
from typing import Final

from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.intervals import MAX_INTERVAL_BYTES, Intervals, Knots, Rate, held_rates
from bufgym.traces.formats.tables import MAX_MBIT_PER_S
from bufgym.traces.formats.text import Line, open_text, split_cells
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S

MAX_INTERVAL_S: Final = 3600  # Longest interval of a speed test, s; a longer one does not measure a changing link

_STAMP: Final = r"(?:\[[0-9T:.+ -]+\] *)?"
INTERVAL: Final = re.compile(_STAMP + r"([0-9.]+) +MB +/ +([0-9.]+) +sec += +([0-9.]+) +Mbps\b(?!.*%TX)(.*)")
REMARK: Final = re.compile(_STAMP + r"(?:nuttcp(?:-[tr])?:.*|[0-9.]+ +MB +/.*%.*|(?:Start|End) time: *[0-9]+|)")
_MBIT_PER_MB: Final = 2**20 * 8e-6
_LOSS: Final = re.compile(r"(-?[0-9]+) +/ +([0-9]+) +~?drop/pkt")  # of a UDP test, packets lost and packets sent
# The interval's length is printed with two decimals.
_LENGTH_ERROR: Final = 0.02


def read_nuttcp(path: StrPath) -> Knots:
    """Lines `[time]  MB / s = Mbps ...` with remarks around them; MB are 2**20 bytes.

    Intervals follow each other with the length that each line states: the stamps say when lines were printed, which
    they are in bursts. A failed run ("error") is no recording, and is refused, as are rates that the bytes contradict.
    Over UDP the bytes are those that the receiver got, and the note says how many packets were lost.
    """
    intervals, lost, sent = Intervals(), 0, 0
    with open_text(path) as file:
        for line in file.lines():
            match = INTERVAL.fullmatch(line.text)
            if match is None:
                if "error" in line.text.lower():
                    raise line.error(line.text, "must be a run that succeeded")
                if not REMARK.fullmatch(line.text):
                    raise line.error(line.text, "must be an interval, MB / sec = Mbps, or a remark of nuttcp")
                continue
            megabytes = line.decimal("MB", match[1], 0, MAX_INTERVAL_BYTES / 2**20)
            length_s = line.decimal("sec", match[2], 0.01, MAX_INTERVAL_S)
            stated = line.decimal("Mbps", match[3], 0, MAX_MBIT_PER_S)
            computed = megabytes * _MBIT_PER_MB / length_s
            if abs(stated - computed) > _LENGTH_ERROR * computed + 0.01:
                raise line.error(match[3], f"must be MB / sec, {computed:.4g}", "Mbps")
            intervals.add(round(length_s * US_PER_S), round(megabytes * 2**20))
            if (loss := _LOSS.search(match[4])) is not None:
                lost, sent = lost + int(loss[1]), sent + int(loss[2])
    udp = f", UDP, {lost:,} of {sent:,} packets lost" if sent else ""
    return intervals.knots(path, f"{len(intervals)} intervals{udp}")


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
