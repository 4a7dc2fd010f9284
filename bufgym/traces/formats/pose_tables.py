"""Poses from tables whose header names their columns, or whose columns are chosen; and by the recipes of other tools.

A table needs a time and x and y, or latitude and longitude. Without z it is flat, and without a quaternion it does not
turn.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from bufgym.traces.formats.faults import StrPath, fault
from bufgym.traces.formats.geodesy import local_plane
from bufgym.traces.formats.recipes import Recipe, field_of, recipes, unit_named
from bufgym.traces.formats.rows import RowReader, Rows, read_rows
from bufgym.traces.formats.tables import cells_of, date_us, place_of, separator_of
from bufgym.traces.formats.text import Line, open_text
from bufgym.traces.formats.trajectories import MOST, NO_TURN, is_number, pose_row
from bufgym.traces.formats.units import UNIT_S, unit_of, warn_of_unit
from bufgym.traces.trace import US_PER_S
from bufgym.utils.errors import BufgymError

_PLACES: Final = (("x", "y", "z"), ("latitude", "longitude", "altitude"))
_TURN: Final = ("qx", "qy", "qz", "qw")
_OWN_COUNTS: Final = (8, 11, 12, 17)  # Columns of TUM, EuRoC and KITTI, whose header is a remark
_TIMES_READ: Final = 1000
_DAY_S: Final = 86_400


@dataclass(frozen=True)
class PoseColumns:
    """Which columns of a table hold what: each by its name in the header, or by its number from 1."""

    time: str
    pose: tuple[str, ...]
    """x, y[, z[, qx, qy, qz, qw]], or names of latitude, longitude[, altitude]."""
    time_unit: str = ""
    """s, ms, us or ns; by default that in the time's name, else found by the steps."""


class _Table(NamedTuple):
    places: dict[str, int]  # of each field
    columns: int  # how many
    separator: str
    header: int  # number of the header's line; 0 where there is none
    unit: str


def read_pose_table(
    path: StrPath, columns: PoseColumns | None, advance: Callable[[int], object] = int
) -> tuple[Rows, str] | None:
    """The poses, with a position and a quaternion each, and what they were read from; None if it is no such table."""
    with open_text(path) as file:
        first = next(file.lines(), None)
    if first is None:
        return None
    recipe = next((one for one in recipes("poses").values() if one.first.fullmatch(first.text)), None)
    if recipe is not None and columns is None:
        if recipe.says:
            raise fault(path, recipe.says)
        rows = read_rows(path, _recipe_row(recipe), what="fixes", advance=advance)
        return _in_metres(rows), recipe.name
    table = _table(path, columns)
    if table is None:
        return None
    row = pose_row(table.places, (table.columns,), table.unit, table.separator)
    rows = read_rows(path, row, skip=table.header, what="poses", advance=advance)
    flat = "latitude" in table.places
    about = f"columns {', '.join(table.places)}, times in {table.unit}"
    return (_in_metres(rows) if flat else rows), about


def _table(path: StrPath, columns: PoseColumns | None) -> _Table | None:
    """How the table is laid out, by its first lines."""
    names, header, places, times, decimals = list[str](), 0, dict[str, int](), list[float](), 0
    count, separator, in_remark = 0, "", False
    with open_text(path) as file:
        for line in file.lines():
            cells = cells_of(line.text, separator_of(line.text))
            is_remark = line.text.startswith("#")
            if not count:
                if is_remark or not any(is_number(cell) for cell in cells):
                    names = cells_of(line.text.lstrip("#"), separator_of(line.text))
                    header, in_remark = line.number, is_remark
                    continue
                count, separator = len(cells), separator_of(line.text)
                if columns is None and (len(names) != count or (in_remark and count in _OWN_COUNTS)):
                    return None
                places = _chosen(line, names, columns) if columns else _by_names(names)
                if not places:
                    return None
            if is_remark or len(cells) != count:
                continue
            text = cells[places["time"]]
            if not is_number(text) or len(times) == _TIMES_READ:
                break
            times.append(float(text))
            decimals = max(decimals, len(text.partition(".")[2]))
    if not count:
        return None
    named = names[places["time"]] if len(names) == count else ""
    unit = (columns.time_unit if columns else "") or unit_named(named)
    if unit and unit not in UNIT_S:
        raise BufgymError(f"time_unit = {unit!r}: must be one of {', '.join(UNIT_S)}")
    if times:
        found = unit or unit_of(path, np.array(times), "s", decimals)
        warn_of_unit(path, np.array(times), found, named=bool(unit))
        unit = found
    return _Table(places, count, separator, header, unit or "s")


def _by_names(names: list[str]) -> dict[str, int]:
    """The place of each field, by the first column of such a name; empty without a time and a place."""
    found: dict[str, int] = {}
    for k, name in enumerate(names):
        found.setdefault(field_of(name), k)
    place = next((fields for fields in _PLACES if {"time", *fields[:2]} <= found.keys()), None)
    if place is None:
        return {}
    turn = _TURN if found.keys() >= {*_TURN} and place is _PLACES[0] else ()
    return {field: found[field] for field in ("time", *place, *turn) if field in found}


def _chosen(line: Line, names: list[str], columns: PoseColumns) -> dict[str, int]:
    """The place of each field as chosen."""
    count = len(cells_of(line.text, separator_of(line.text)))
    names = names if len(names) == count else [str(k + 1) for k in range(count)]
    if len(columns.pose) not in (2, 3, 7):
        raise BufgymError(f"pose = {' '.join(columns.pose)}: must be x y, x y z, or x y z qx qy qz qw")
    fields = _PLACES[field_of(columns.pose[0]) == "latitude"]
    wanted = dict(zip((*fields, *_TURN), columns.pose, strict=False))
    return {field: place_of(line, names, name) for field, name in {"time": columns.time, **wanted}.items()}


def _recipe_row(recipe: Recipe) -> RowReader:
    """The reader of a fix of a satellite receiver."""
    above_us = [0]

    def row(line: Line, previous: list[float] | None) -> tuple[str, int, list[float]] | None:
        groups = recipe.groups(line)
        if groups is None:
            return None
        place = []
        for field, most in MOST.items():
            text, value = groups.get(f"{field}_dm"), float(groups.get(field) or 0)
            if text:  # degrees and two digits of minutes before the point
                at = text.index(".") - 2
                value = int(text[:at]) + float(text[at:]) / 60
            place.append(line.decimal(field, f"{value:.12f}", -most, most))
        place[0] *= -1 if groups.get("ns") == "S" else 1
        place[1] *= -1 if groups.get("ew") == "W" else 1
        if (text := groups.get("date", "")) and (date := date_us(text)) is not None:
            return text, date, [*place, *NO_TURN]
        if not (text := groups.get("hms", "")):
            raise line.error(line.text, "must hold a time")
        us = round((int(text[:2]) * 3600 + int(text[2:4]) * 60 + float(text[4:])) * US_PER_S)
        while us < above_us[0] - _DAY_S * US_PER_S // 2:
            us += _DAY_S * US_PER_S  # after midnight
        above_us[0] = us
        return text, us, [*place, *NO_TURN]

    return row


def _in_metres(rows: Rows) -> Rows:
    values = rows.values.copy()
    values[:, :3] = local_plane(values[:, :3])
    return rows._replace(values=values, note=f", positions of a satellite receiver, no orientation{rows.note}")
