"""The errors that bufgym raises on purpose.

One family: `except BufgymError` catches whatever the caller can put right (a bad parameter, a broken file).
Anything else that escapes is a bug of bufgym.
"""

from __future__ import annotations

import importlib.metadata
import os
import re
import traceback
from os import PathLike

_MOST_CHARACTERS = 60
"""Longer values are cut in messages: a broken file can hold a line of any length."""
_MOST_MESSAGE = 2000
"""Characters."""


def printable(text: object) -> str:
    """The text on one line, without a character that a terminal obeys: each is written as in Python (``\\x1b``).

    Names come from files of strangers: a newline in one could forge a line of output, an escape code hide another.
    """
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))


class BufgymError(ValueError):
    """A value that bufgym cannot work with; the message names the value and the rule that it breaks, on one line."""

    def __init__(self, message: object = "") -> None:
        text = printable(message)
        # The place stands at the beginning and the rule at the end; what is between may be as long as a file.
        super().__init__(text if len(text) <= _MOST_MESSAGE else f"{text[:1000]}...{text[-500:]}")


class TraceError(BufgymError):
    """A trace or motion file that cannot be read or written; the message names the file and the line."""


def where(
    path: str | PathLike[str],
    line: int | None,
    value: object | None,
    rule: str,
    *,
    field: str | None = None,
) -> str:
    """Say where something is wrong, what it is, and which rule it breaks.

    Args:
        path: the file, as the caller wrote it.
        line: line number, counted from 1; None when the file as a whole is meant.
        value: the offending value as it stands in the file; None when there is none to show.
        rule: what would have been right, to be read after the value ("must be a whole number >= 0").
        field: what the value is, such as a column's name.

    Returns:
        For example "lte.csv, line 12: bytes = -3: must be a whole number >= 0".
    """
    place = f"{path}" if line is None else f"{path}, line {line}"
    if value is None:
        return f"{place}: {rule}" if field is None else f"{place}: {field} {rule}"
    text = _quoted(value)
    return f"{place}: {text}: {rule}" if field is None else f"{place}: {field} = {text}: {rule}"


def _quoted(value: object) -> str:
    """Plain words and numbers as they stand; blanks, spaces and control characters quoted; long text cut."""
    text = str(value)
    cut = text if len(text) <= _MOST_CHARACTERS else text[: _MOST_CHARACTERS - 3] + "..."
    plain = cut.isprintable() and cut.isascii() and cut != "" and " " not in cut
    return cut if plain else repr(cut)


def line_in(error: Exception, file: str) -> str | None:
    """Where in that file the error came from ("mine.py, line 3", the innermost line), or None."""
    lines = [
        line
        for frame, line in traceback.walk_tb(error.__traceback__)
        if os.path.abspath(frame.f_code.co_filename) == os.path.abspath(file)
    ]
    return f"{file}, line {lines[-1]}" if lines else None


def install(extra: str) -> str:
    """The command that installs what an optional part needs.

    It names the packages of the extra, and so works from a checkout and beside an installed bufgym alike: both carry
    the list, and no package index need know bufgym.
    """
    try:
        packages = _packages(importlib.metadata.requires("bufgym") or [], extra)
    except importlib.metadata.PackageNotFoundError:  # a source tree that was never installed
        packages = []
    quoted = [name if re.fullmatch(r"[\w.-]+", name) else f'"{name}"' for name in packages]
    return f"pip install {' '.join(quoted)}" if packages else f'pip install -e ".[{extra}]"'


def _packages(requirements: list[str], extra: str) -> list[str]:
    """What the extra asks for, with what the extras of bufgym's own that it names ask for."""
    found: list[str] = []
    for requirement in requirements:
        package, _, condition = requirement.partition(";")
        if not re.search(rf"""extra == ['"]{re.escape(extra)}['"]""", condition):
            continue
        own = re.fullmatch(r"bufgym\[([\w,-]+)\]", package.strip())
        found += [name for e in own[1].split(",") for name in _packages(requirements, e)] if own else [package.strip()]
    return found
