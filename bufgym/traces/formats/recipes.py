"""What other tools write, read by the recipes of ``recipes.toml``: patterns of lines, and names of columns."""

import functools
import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.intervals import MAX_INTERVAL_BYTES, MAX_MBIT_PER_S, Intervals, Knots
from bufgym.traces.formats.mahimahi import MAX_STAMP_MS, packets_at
from bufgym.traces.formats.text import Line, open_text
from bufgym.traces.trace import MAX_DURATION_S, US_PER_S
from bufgym.utils.files import read_toml
from bufgym.utils.units import RATES

_PREFIXES: Final = {"": 0, "K": 10, "M": 20, "G": 30}
_MAX_COUNTER: Final = 2**63 - 1
_MAX_EPOCH_S: Final = 10**11
_OFF: Final = 0.02  # Share of a stated rate: the length is printed with two decimals
_ROUNDED_S: Final = 0.11  # Edges of intervals are printed with one decimal, or more


@dataclass(frozen=True)
class Recipe:
    """How the text of a tool is read; see ``recipes.toml``."""

    name: str
    about: str
    first: re.Pattern[str]
    line: re.Pattern[str] | None = None
    clock: re.Pattern[str] | None = None
    skip: re.Pattern[str] | None = None
    columns: tuple[str, ...] = ()
    says: str = ""

    def samples(self, path: StrPath) -> Iterator[tuple[Line, dict[str, str]]]:
        """Each line that says something, with its groups, and with those of the latest clock."""
        if self.says:
            raise fault(path, self.says)
        latest: dict[str, str] = {}
        with open_text(path) as file:
            for line in file.lines():
                if (groups := self.groups(line)) is None:
                    continue
                if self.clock is not None and groups.keys() <= self.clock.groupindex.keys():
                    latest = groups
                else:
                    yield line, {**latest, **groups}

    def groups(self, line: Line) -> dict[str, str] | None:
        """The groups of a line, of the clock or of a sample; None for a line that says nothing."""
        for pattern in (self.clock, self.line):
            match = pattern and pattern.fullmatch(line.text)
            if match:
                return {name: text for name, text in match.groupdict().items() if text is not None}
        if self.skip is None or not self.skip.fullmatch(line.text):
            raise line.error(line.text, f"must be a line of {self.name} ({self.about})")
        return None


@functools.cache
def recipes(kind: str) -> dict[str, Recipe]:
    """The recipes for "links" or "poses"."""
    made = {}
    for name, fields in _data()[kind].items():
        patterns = {key: re.compile(fields[key]) for key in ("first", "line", "clock", "skip") if key in fields}
        about, columns, says = fields["about"], tuple(fields.get("columns", ())), fields.get("says", "")
        made[name] = Recipe(name, about, columns=columns, says=says, **patterns)
    return made


@functools.cache
def _data() -> dict[str, Any]:
    return read_toml(Path(__file__).with_name("recipes.toml"))


@functools.cache
def _fields() -> dict[str, str]:
    return {name: field for field, names in _data()["names"].items() for name in names}


def field_of(name: str) -> str:
    """What a column of this name holds ("time", "qx"); empty for other names."""
    plain = re.sub(r"\s*[(\[].*[)\]]$", "", name.strip().strip("#").strip().lower())
    parts = plain.split(".")
    tried = (".".join(parts[k:]) for k in range(len(parts)))
    return next((_fields()[one] for one in tried if one in _fields()), "")


def unit_named(name: str) -> str:
    """The unit that the name of a column of times ends with; empty where it has none."""
    match = re.search(r"(?:^|[\[(_ ])(s|sec|ms|us|ns|nsec)[\])]?$", name.strip())
    return match[1].removesuffix("ec") if match else ""


def read_link(path: StrPath, recipe: Recipe, column: str | None = None) -> Knots:
    """The capacity that a tool measured."""
    samples = recipe.samples(path)
    if recipe.line is not None and "packet" in recipe.line.groupindex:
        return _packets(path, samples)
    if recipe.columns:
        return _counted(path, samples, column or recipe.columns[0])
    return _intervals(path, recipe, samples)


def _packets(path: StrPath, samples: Iterator[tuple[Line, dict[str, str]]]) -> Knots:
    """Packets as in a trace of mahimahi, from the base on."""
    stamps_ms = array("q")
    for line, groups in samples:
        base_ms = line.whole("base timestamp", groups.get("base", "0"), MAX_STAMP_MS)
        stamp_ms = line.whole("time in ms", groups["packet"], base_ms + MAX_STAMP_MS) - base_ms
        if stamp_ms < (stamps_ms[-1] if stamps_ms else 0):
            raise line.error(groups["packet"], "must not be before the line above, nor before the base", "time in ms")
        stamps_ms.append(stamp_ms)
    return packets_at(path, np.maximum(np.array(stamps_ms, np.int64), 1))


def _intervals(path: StrPath, recipe: Recipe, samples: Iterator[tuple[Line, dict[str, str]]]) -> Knots:
    """Intervals that follow each other; of parallel streams, their sums. Totals over all of them are left out."""
    ids = list[str]()
    if recipe.line is not None and "id" in recipe.line.groupindex:
        samples = iter(found := list(samples))
        ids = list(dict.fromkeys(groups["id"] for _, groups in found))
    if len(ids) > 1 and "SUM" not in ids:
        raise fault(path, f"holds streams {', '.join(ids[:8])} and no sum of them: must hold one, or lines of [SUM]")
    intervals, end_s, lost, sent = Intervals(), None, 0, 0
    for line, groups in samples:
        if len(ids) > 1 and groups["id"] != "SUM":
            continue
        if "length_ms" in groups:
            intervals.add_ending_at(line, groups["end_ms"], groups["length_ms"], groups["bytes"])
            continue
        length_us = round(line.decimal("sec", groups.get("length", "1"), 0.01, MAX_DURATION_S) * US_PER_S)
        if "end" in groups:
            start, end = (line.decimal(name, groups[name], 0, MAX_DURATION_S) for name in ("start", "end"))
            if end_s is not None and start == 0 and end > end_s - _ROUNDED_S:
                continue  # the total
            if end_s is not None and abs(start - end_s) > _ROUNDED_S:
                raise line.error(groups["start"], f"must begin where the line above ended ({end_s:g} s)", "start in s")
            length_us = round((end - (start if end_s is None else end_s)) * US_PER_S)
            if length_us <= 0:
                raise line.error(groups["end"], "must be after its start", "end in s")
            end_s = end
        field, unit = "bytes", 2.0 ** _PREFIXES[groups.get("prefix", "")]
        if "unit" in groups:
            field, unit = groups["unit"], RATES[groups["unit"]]
        count = round(line.decimal(field, groups["bytes"], 0, MAX_INTERVAL_BYTES / unit) * unit)
        if "mbps" in groups:
            stated, computed = line.decimal("Mbps", groups["mbps"], 0, MAX_MBIT_PER_S), count * 8 / length_us
            if abs(stated - computed) > _OFF * computed + 0.01:
                raise line.error(groups["mbps"], f"must be MB / sec, {computed:.4g}", "Mbps")
        intervals.add(length_us, count)
        lost, sent = lost + int(groups.get("lost", 0)), sent + int(groups.get("sent", 0))
    udp = f", UDP, {lost:,} of {sent:,} packets lost" if sent else ""
    return intervals.knots(path, f"{len(intervals)} intervals{udp}")


def _counted(path: StrPath, samples: Iterator[tuple[Line, dict[str, str]]], column: str) -> Knots:
    """Intervals by a counter's steps: what went through between two lines, whatever lies between them."""
    intervals, ids, above = Intervals(), set[str](), None
    for line, groups in samples:
        if column not in groups:
            continue
        ids.add(groups.get("id", ""))
        if len(ids) > 1:
            raise line.error(line.text, f"must be of one interface, not of {' and '.join(sorted(ids))}")
        if "clock" not in groups:
            raise line.error(line.text, "must stand below a line with the time")
        time_us = round(line.decimal("time in s", groups["clock"], 0, _MAX_EPOCH_S) * US_PER_S)
        count = line.whole(column, groups[column], _MAX_COUNTER)
        if above is not None:
            if not above[0] < time_us <= above[0] + MAX_DURATION_S * US_PER_S:
                rule = f"must be after the time above ({above[0] / US_PER_S:.6f}), by at most {MAX_DURATION_S} s"
                raise line.error(groups["clock"], rule, "time in s")
            if count < above[1]:
                rule = f"must not be below the line above ({above[1]}): the counter began anew, so split the file there"
                raise line.error(count, rule, column)
            if count - above[1] > MAX_INTERVAL_BYTES:
                raise line.error(count, f"must be at most {MAX_INTERVAL_BYTES} more than above", column)
            intervals.add(time_us - above[0], count - above[1])
        above = time_us, count
    return intervals.knots(path, f"{column}, by a counter's steps")
