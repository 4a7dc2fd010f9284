"""What the pages about trained agents share: their commands, tables, and how numbers are written."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from bufgym.errors import BufgymError


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """A Markdown table, line by line."""
    return [_line(head), "|---" * len(head) + "|", *map(_line, rows)]


def _line(cells: Sequence[object]) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def columns_of(file: Path, *names: str) -> list[tuple[float, ...]]:
    """These columns of a curve that a run left, a tuple a row."""
    with file.open(newline="", encoding="utf-8") as lines:
        return [tuple(float(row[name]) for name in names) for row in csv.DictReader(lines)]


def publish(
    module: str,
    doc: str | None,
    add_options: Callable[[argparse.ArgumentParser], object],
    page: Callable[[argparse.Namespace], str],
    arguments: Sequence[str] | None,
) -> None:
    """The command ``python -m MODULE``: make the page, write it to ``--out``, and print it.

    Args:
        module: its dotted name.
        doc: its docstring, for ``--help``.
        add_options: adds the command's own options.
        page: options -> the page's text.
        arguments: those of the command line by default.
    """
    parser = argparse.ArgumentParser(prog=f"python -m {module}", description=doc)
    add_options(parser)
    parser.add_argument("--out", type=Path, default=None, help="Markdown file to write; printed in any case")
    options = parser.parse_args(arguments)
    try:
        text = page(options)
    except BufgymError as error:
        raise SystemExit(f"error: {error}") from None
    if options.out:
        options.out.write_text(text, encoding="utf-8")
    print(text)
