"""Rows in files: read back to the last bit, written whole or not at all, every bad cell named."""

from __future__ import annotations

import math
import stat
import sys
from pathlib import Path
from typing import Any

import pytest

from bufgym.benchmark.rows import RUNS, Row, read_rows, write_rows
from bufgym.errors import BufgymError
from bufgym.files import replaced

ENDINGS = ["csv", "parquet"]


def row(**changed: Any) -> Row:
    """A row with a different cell in every column."""
    cells = {str: "{0} text".format, bool: lambda _, __: True, int: lambda _, k: k, float: lambda _, k: k / 7}
    return {name: cells[kind](name, k) for k, (name, kind) in enumerate(RUNS.items())} | changed


HARD = [
    row(),
    row(qoi=0.1 + 0.2, regret=5e-324, mean_age_s=1.7976931348623157e308, peak_backlog_bytes=2**62 + 1),
    row(mean_sojourn_s=math.nan, clairvoyant=None, certified=None, regret=None),
    row(certified=False, regret=-0.0, longest_gap=math.inf, seed=2**53 + 1),
    row(scenario='a, "quoted"\nlabel', trace="Übertragung;\t'x'", policy="decimate:every=2,phase=1"),
    row(scenario="", qoi=3.0),
]
"""Numbers that need all their bits, nothing in all its forms, text that a CSV must quote."""


def needs(ending: str) -> str:
    if ending == "parquet":
        pytest.importorskip("pyarrow")
    return ending


@pytest.mark.parametrize("ending", ENDINGS)
def test_rows_come_back_to_the_last_bit(tmp_path: Path, ending: str) -> None:
    path = write_rows(HARD, tmp_path / f"rows.{needs(ending)}")
    # repr tells None from NaN, 3 from 3.0, 0.0 from -0.0, and shows every bit of a float.
    assert [repr(same) for same in read_rows(path)] == [repr(given) for given in HARD]
    assert list(tmp_path.iterdir()) == [path]  # nothing temporary stays
    again = write_rows(read_rows(path), tmp_path / f"again.{ending}")
    assert again.read_bytes() == path.read_bytes()
    assert read_rows(write_rows([], path)) == []
    with pytest.raises(FileNotFoundError):
        read_rows(tmp_path / f"none.{ending}")


def test_a_new_file_is_as_readable_as_any_other(tmp_path: Path) -> None:
    path, plain = write_rows(HARD, tmp_path / "rows.csv"), tmp_path / "plain"
    plain.touch()
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    target = write_rows(HARD, tmp_path / "rows.csv")
    before = target.read_bytes()
    with pytest.raises(ValueError, match="not in fieldnames"):
        write_rows([row(), row(surprise=1)], target)
    with pytest.raises(KeyboardInterrupt), replaced(target) as temporary:
        temporary.write_text("half a")
        raise KeyboardInterrupt
    assert target.read_bytes() == before and list(tmp_path.iterdir()) == [target]


def test_other_endings_and_parquet_without_pyarrow_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(BufgymError, match=r"rows\.txt: rows are written to \.csv or \.parquet"):
        write_rows([], tmp_path / "rows.txt")
    monkeypatch.setitem(sys.modules, "pyarrow", None)  # importing it now fails
    with pytest.raises(BufgymError, match=r"pip install .*pyarrow.* \(or write \.csv\)"):
        write_rows(HARD, tmp_path / "rows.parquet")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("column", "cell", "told"),
    [
        ("qoi", "many", "qoi = 'many': must be a number"),
        ("seed", "1.5", "seed = '1.5': must be a number"),
        ("certified", "yes", "certified = 'yes': must be True or False"),
        ("regret", "1;2", "regret = '1;2': must be a number"),
    ],
)
def test_a_bad_cell_is_named_with_its_line(tmp_path: Path, column: str, cell: str, told: str) -> None:
    """In the third row of a file whose first row's label spans two lines: line 1 + 2 + 1 + 1 = 5."""
    path = write_rows([row(scenario="two\nlines"), row(), row(**{column: cell})], tmp_path / "rows.csv")
    with pytest.raises(BufgymError) as caught:
        read_rows(path)
    assert str(caught.value) == f"{path}, line 5: {told}"


@pytest.mark.parametrize("change", [lambda line: line.rsplit(",", 1)[0], lambda line: f"{line},7"])
def test_a_line_of_another_length_is_named(tmp_path: Path, change: Any) -> None:
    path = write_rows([row(), row()], tmp_path / "rows.csv")
    *rest, last = path.read_text().splitlines()
    path.write_text("\n".join([*rest, change(last)]) + "\n")
    with pytest.raises(BufgymError, match=rf"rows\.csv, line 3: must have {len(RUNS)} cells, as line 1 has"):
        read_rows(path)


@pytest.mark.parametrize(
    "content", [b"policy,qoi\nafr,\xff\xfe\n", b'policy,qoi\n"afr"x,1\n', b'policy,qoi\n"afr,1\n', 0, 0.3, 0.9]
)
def test_a_file_that_is_none_or_cut_short_is_named(tmp_path: Path, content: bytes | float) -> None:
    """As CSV, or so much of a Parquet file."""
    path = tmp_path / "rows.csv"
    if not isinstance(content, bytes):
        pytest.importorskip("pyarrow")
        path = write_rows(HARD, tmp_path / "rows.parquet")
        content = path.read_bytes()[: round(content * path.stat().st_size)]
    path.write_bytes(content)
    with pytest.raises(BufgymError, match=rf"{path.name}: no rows that can be read"):
        read_rows(path)


def test_one_wrong_bit_in_a_parquet_page_is_noticed(tmp_path: Path) -> None:
    """Or else a number would be another and nobody the wiser. (Some bits say nothing that is needed.)"""
    pytest.importorskip("pyarrow")
    rows = [row(qoi=1234.5678 + k, mean_age_s=1 / (k + 1)) for k in range(50)]
    path = write_rows(rows, tmp_path / "rows.parquet")
    right, content = repr(rows), path.read_bytes()
    noticed = 0
    for place in range(4, len(content) // 3, 101):
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        try:
            assert repr(read_rows(path)) == right, place
        except BufgymError:
            noticed += 1
    assert noticed > 10
