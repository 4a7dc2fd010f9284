"""The report of a suite's run: one HTML page that needs no network, and tables for a README.

It reads what ``bufgym bench --suite`` left in a folder. There is no simulator in here, and no statistic: those are
``bufgym.benchmark.score``'s.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bufgym.benchmark.folder import Run, read
from bufgym.benchmark.report import page, tables
from bufgym.benchmark.score import Scores, scores
from bufgym.errors import BufgymError
from bufgym.files import replaced

__all__ = ["markdown", "plain", "write"]


def write(folder: str | Path) -> Path:
    """Write ``report.html`` into the folder of a run; return its path.

    Raises:
        BufgymError: for a folder without a run, a broken file in it, rows that can't be scored, or where plotly or
            Jinja is not installed.
    """
    run = read(Path(folder))
    made = page.html(run, _scored(run))
    target = run.folder / "report.html"
    with replaced(target) as temporary:
        temporary.write_text(made, encoding="utf-8")
    return target


def markdown(folder: str | Path) -> str:
    """The command, the ranking and the scores of every cell as Markdown, for a README. Errors as for ``write``."""
    run = read(Path(folder))
    return tables.markdown(run, _scored(run))


def plain(folder: str | Path) -> str:
    """The ranking as text, for a terminal. Errors as for ``write``."""
    run = read(Path(folder))
    return tables.plain(run, _scored(run))


def _scored(run: Run) -> Scores:
    """The scores, scenarios in the order of the manifest."""
    try:
        found = scores(run.rows, unranked=run.manifest["unranked"])
    except BufgymError as error:
        raise BufgymError(f"{run.rows_file}: {error}") from None
    return replace(found, cells=sorted(found.cells, key=lambda c: (run.place(c.scenario), c.capacity, c.policy)))
