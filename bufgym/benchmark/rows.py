"""Rows in files: CSV or Parquet, written whole or not at all, read back to the last bit."""

import csv
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, get_type_hints

from bufgym.sim.metrics import Outcome
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import replaced
from bufgym.utils.libraries import library

Row = dict[str, Any]
Layout = Mapping[str, type]
"""The columns of one kind of rows, in their order, with the kind of their cells: str, int, float or bool."""


def columns_of(outcome: type) -> dict[str, type]:
    """The fields of a dataclass of statistics as columns."""
    kinds = get_type_hints(outcome)
    return {field.name: kinds[field.name] for field in fields(outcome)}


RUNS: Layout = {
    **{"scenario": str, "trace": str, "seed": int, "policy": str, "capacity": int},
    **columns_of(Outcome),
    **{"clairvoyant": float, "certified": bool, "regret": float},
}
"""One row for each run of one queue.

``clairvoyant`` is the best possible H of this episode at this capacity. ``certified`` says whether that is exact or an
upper bound, and ``regret`` = 1 - H / clairvoyant. They are None if no bound was requested. ``regret`` is also None for
a policy that is not bound by L.
"""

_MORE: Layout = {"training_seed": int}  # optional columns of any layout; columns of other names hold floats


def checked_target(path: str | os.PathLike[str]) -> Path:
    """Return the path; raise an error if rows can't be written to a file of that kind here."""
    target = Path(path)
    if target.suffix not in (".csv", ".parquet"):
        latex = '; for LaTeX bufgym.compare(...).table("latex")' if target.suffix == ".tex" else ""
        raise BufgymError(f"{target}: rows are written to .csv or .parquet files{latex}")
    if target.suffix == ".parquet":
        _pyarrow()
    return target


def write_rows(rows: Sequence[Mapping[str, Any]], path: str | os.PathLike[str], layout: Layout = RUNS) -> Path:
    """Write rows to a ``.csv`` or ``.parquet`` file, whole or not at all; None becomes an empty cell or null."""
    target = checked_target(path)
    columns = list(rows[0]) if rows else list(layout)
    if target.suffix == ".parquet":
        pyarrow, parquet = _pyarrow()
        kinds = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64(), bool: pyarrow.bool_()}
        schema = pyarrow.schema([(name, kinds[_kind(name, layout)]) for name in columns])
        table = pyarrow.Table.from_pylist([dict(row) for row in rows], schema=schema)
        with replaced(target) as temporary:
            parquet.write_table(table, temporary, write_page_checksum=True)
        return target
    with replaced(target) as temporary, open(temporary, "w", encoding="utf-8", newline="") as file:
        # Floats are written so that they read back to the last bit.
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return target


def read_rows(path: str | os.PathLike[str], layout: Layout = RUNS) -> list[Row]:
    source = Path(path)
    if source.exists() and not source.is_file():
        raise BufgymError(f"{source}: must be a regular file")
    if source.suffix == ".parquet":
        return _read_parquet(source)
    with open(source, encoding="utf-8", newline="") as file:
        return [row for _, row in parsed(source, file, layout)]


def parsed(source: Path, text: Iterable[str], layout: Layout) -> list[tuple[int, Row]]:
    """Parse the lines of a CSV file to (number of the line, row); an error names the line and the cell."""
    reader = csv.DictReader(text, strict=True)
    try:
        lines = [(reader.line_num, line) for line in reader]
    except (UnicodeDecodeError, csv.Error) as error:
        raise BufgymError(f"{source}: no rows that can be read: {error}") from None
    for number, line in lines:  # extra cells have the name None, and missing cells the value None
        if None in line or None in line.values():
            raise BufgymError(f"{source}, line {number}: must have {len(reader.fieldnames or ())} cells, as line 1 has")
    return [
        (number, {name: _parsed(source, number, name, cell, layout) for name, cell in line.items()})
        for number, line in lines
    ]


def _read_parquet(source: Path) -> list[Row]:
    _, parquet = _pyarrow()
    with open(source, "rb") as file:
        try:
            # pyarrow checks a page's checksum only on request.
            rows: list[Row] = parquet.read_table(file, page_checksum_verification=True).to_pylist()
        except Exception as error:  # pyarrow's own errors are OSErrors and ValueErrors of many kinds
            raise BufgymError(f"{source}: no rows that can be read: {str(error).splitlines()[0]}") from None
    return rows


def _kind(name: str, layout: Layout) -> type:
    return layout.get(name) or _MORE.get(name, float)


def _parsed(path: Path, line: int, name: str, text: str, layout: Layout) -> Any:
    kind = _kind(name, layout)
    if kind is str or text == "":
        return text if kind is str else None
    try:
        return {"True": True, "False": False}[text] if kind is bool else kind(text)
    except (KeyError, ValueError):
        rule = "True or False" if kind is bool else "a number"
        raise BufgymError(f"{path}, line {line}: {name} = {text!r}: must be {rule}") from None


def _pyarrow() -> tuple[Any, Any]:
    pyarrow, parquet = (
        library(name, "bench", "a Parquet file, unlike .csv,") for name in ("pyarrow", "pyarrow.parquet")
    )
    return pyarrow, parquet
