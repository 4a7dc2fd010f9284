"""Errors that bufgym raises on purpose.

``except BufgymError`` catches every error that the caller can put right. Any other exception is a bug in bufgym.
"""

import importlib.metadata
from collections.abc import Iterable
from os import PathLike

_MOST_CHARACTERS = 60  # longest value shown in a message, characters: a broken file can hold a line of any length
_MOST_MESSAGE = 2000  # longest message, characters


def printable(text: object) -> str:
    """Return the text on one line, with every character that a terminal obeys written as in Python (``\\x1b``).

    Names come from untrusted files. A newline could forge a line of output, and an escape code could hide another.
    """
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))


class BufgymError(ValueError):
    """A value that bufgym cannot work with; the message names the value and the broken rule, on one line.

    It is a ``ValueError``, and so are the errors below.
    """

    def __init__(self, message: object = "") -> None:
        text = printable(message)
        # The message begins with the place and ends with the rule; the value between may be as long as a file.
        super().__init__(text if len(text) <= _MOST_MESSAGE else f"{text[:1000]}...{text[-500:]}")


class UnknownArgumentError(BufgymError, TypeError):
    """A keyword argument that nothing takes; also a ``TypeError``, whose message begins with Python's own words.

    So a library that tries an argument and leaves it out at Python's error goes on.
    """


class TraceError(BufgymError):
    """A trace or motion file that cannot be read or written; the message names file and line."""


class TraceWarning(UserWarning):
    """A doubt about a file that is read nevertheless; the message names the file, the place and the value."""

    def __init__(self, message: object = "") -> None:
        super().__init__(printable(message))


def unknown(what: str, name: object, known: Iterable[str], also: str = "", place: str = "") -> BufgymError:
    """The error for a name that is not among those ``known``: names the one that was meant, or all of them."""
    import difflib  # not at start-up: few names are wrong

    names = list(known)
    small = {each.lower(): each for each in reversed(names)}  # LTE is meant as lte
    close = difflib.get_close_matches(str(name).lower(), small, 1)
    hint = f"did you mean {small[close[0]]!r}?" if close else f"known: {', '.join(names) or 'none'}{also}"
    return BufgymError(f"{place and f'{place}: '}unknown {what} {name!r}; {hint}")


def where(
    path: str | PathLike[str], line: int | None, value: object | None, rule: str, *, field: str | None = None
) -> str:
    """Say where an error is, which value is wrong, and which rule it breaks.

    Args:
        path: the file, as the caller wrote it.
        line: line number, counted from 1; None for the file as a whole.
        value: the offending value as it stands in the file; None if there is none to show.
        rule: the requirement, to be read after the value ("must be a whole number >= 0").
        field: name of the value, such as a column's.

    Returns:
        For example "lte.csv, line 12: bytes = -3: must be a whole number >= 0".
    """
    place = f"{path}" if line is None else f"{path}, line {line}"
    if value is None:
        return f"{place}: {rule}" if field is None else f"{place}: {field} {rule}"
    text = _quoted(value)
    return f"{place}: {text}: {rule}" if field is None else f"{place}: {field} = {text}: {rule}"


def _quoted(value: object) -> str:
    """Quote blanks, spaces and control characters; leave plain words and numbers as they are; cut long text."""
    text = str(value)
    cut = text if len(text) <= _MOST_CHARACTERS else text[: _MOST_CHARACTERS - 3] + "..."
    plain = cut.isprintable() and cut.isascii() and cut != "" and " " not in cut
    return cut if plain else repr(cut)


def install(extra: str) -> str:
    """The command that installs an extra of bufgym ("plot"), or of a package beside it ("bufgym-NAME[EXTRA]").

    pip finds the extra in what is installed, so no package index needs to know bufgym.
    """
    package, _, bracket = (extra if "[" in extra else f"bufgym[{extra}]").partition("[")
    try:
        importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:  # a source tree that was never installed
        folder = "." if package == "bufgym" else f"packages/{package.removeprefix('bufgym-')}"
        return f'pip install -e "{folder}[{bracket}"'
    return f'pip install "{package}[{bracket}"'
