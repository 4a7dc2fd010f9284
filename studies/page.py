"""Shared parts of the pages about trained agents: commands, tables, and the form of numbers."""

import csv
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from cyclopts import App

from bufgym.benchmark import bootstrap
from bufgym.benchmark.bootstrap import Interval
from bufgym.cli.options import OPTIONS
from bufgym.utils.errors import BufgymError


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """A Markdown table, line by line."""
    return [_line(head), "|---" * len(head) + "|", *map(_line, rows)]


def _line(cells: Sequence[object]) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def written(interval: Interval, form: str) -> str:
    """An interval as text such as 1.03 [1.01, 1.05], with this format for each number."""
    return " ".join(filter(None, bootstrap.written(interval, lambda number: format(number, form))))


def columns_of(file: Path, *names: str) -> list[tuple[float, ...]]:
    """These columns of a curve from a run's folder, a tuple per row."""
    with file.open(newline="", encoding="utf-8") as lines:
        return [tuple(float(row[name]) for name in names) for row in csv.DictReader(lines)]


def publish(text: str, out: Path | None) -> None:
    """Write the page to ``out`` if given, and print it."""
    if out:
        out.write_text(text, encoding="utf-8")
    print(text)


def command(page: Callable[..., None]) -> None:
    """Run a page's function as a command: its arguments are the options; a mistake ends in one line."""
    try:
        App(default_command=page, default_parameter=OPTIONS)()
    except BufgymError as error:
        raise SystemExit(f"error: {error}") from None
