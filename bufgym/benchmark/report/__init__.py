"""Report of a suite's run: one HTML page that needs no network, and tables for a terminal or a README.

It reads a folder of ``bufgym bench --suite``. It simulates nothing and takes all statistics from the task.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from bufgym import policies
from bufgym.benchmark.folder import SuiteRun, read
from bufgym.benchmark.report import page, tables
from bufgym.benchmark.summary import Summary
from bufgym.ground.errors import BufgymError
from bufgym.ground.files import replaced

__all__ = ["html", "markdown", "plain", "write"]


def write(folder: str | Path) -> Path:
    """Write ``report.html`` into the folder of a run; return its path.

    Raises:
        BufgymError: for a folder without a run, a broken file in it, rows that can't be scored, or where matplotlib or
            Jinja is not installed.
    """
    run, summary = _read(folder)
    text = page.html(run, summary)
    target = run.folder / "report.html"
    with replaced(target) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return target


def markdown(folder: str | Path, against: str | None = None) -> str:
    """The command, the ranking and the tables of every cell as Markdown, for a README. Errors as for ``write``.

    ``against`` is the policy that every other is compared with, by default ``best_rule``; empty for none.
    """
    return tables.markdown(*_read(folder, against))


def html(folder: str | Path, against: str = "") -> str:
    """The ranking as an HTML table, for a notebook. Errors as for ``write``."""
    return tables.html(_read(folder, against)[1])


def plain(folder: str | Path, against: str = "") -> str:
    """The summary as text, for a terminal. Errors as for ``write``."""
    return tables.plain(*_read(folder, against))


def best_rule(summary: Summary) -> str:
    """The first ranked policy that was not learned; empty if all were."""
    for standing in summary.overall:
        with suppress(BufgymError):  # a run's agent that is not registered
            if standing.ranked and not policies.get(standing.policy).weights:
                return "" if math.isnan(standing[summary.rank_by].value) else standing.policy
    return ""


def _read(folder: str | Path, against: str | None = None) -> tuple[SuiteRun, Summary]:
    """The run and its summary, scores in the order of the manifest's scenarios."""
    run = read(Path(folder))
    try:
        summary = run.task.summary(run.rows, run.manifest["unranked"], against or "")
        if against is None and (rule := best_rule(summary)):
            summary = run.task.summary(run.rows, run.manifest["unranked"], rule)
    except BufgymError as error:
        raise BufgymError(f"{run.rows_file}: {error}") from None
    if summary.scores is not None:
        place = {scenario: k for k, scenario in enumerate(run.manifest["scenarios"])}  # any others come last, by name
        cells = sorted(
            summary.scores.cells, key=lambda c: (place.get(c.scenario, len(place)), c.scenario, c.capacity, c.policy)
        )
        summary = replace(summary, scores=replace(summary.scores, cells=cells))
    return run, summary
