"""Small pieces of Markdown."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import fields
from typing import Any

from bufgym.model.documented import below_fields


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Make a table with columns of numbers to the right; bars and line breaks in cells are escaped."""
    cells = [[_cell(cell) for cell in row] for row in rows]
    numbers = [
        all(re.fullmatch(r"[-\d.,%]+( \[.*\])?", cell) for cell in column) for column in zip(*cells, strict=True)
    ]
    lines = [head, ["---:" if right else "---" for right in numbers], *cells]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())


def code(text: str) -> str:
    """Replace the double backquotes of docstrings by single ones."""
    return re.sub(r"``([^`]+)``", r"`\1`", text)


def cited(text: str, up: str = "") -> str:
    """Turn keys of papers in brackets into links to the list of papers."""
    return re.sub(r"\[([a-z]+\d{4}[a-z]+|zenoh|fastdds|webrtc)\]", rf"[\1]({up}papers.md#\1)", text)


def attributes(class_: type[Any]) -> dict[str, str]:
    """Map each field of a dataclass and its bases to the string below it."""
    return {name: text for base in reversed(class_.__mro__[:-1]) for name, text in below_fields(base).items()}


def parameters(example: Any) -> str:
    """A table of a dataclass's fields: name, value in ``example``, meaning."""
    meanings = attributes(type(example))
    rows = [(f"`{f.name}`", _value(getattr(example, f.name)), code(meanings.get(f.name, ""))) for f in fields(example)]
    return table(("parameter", "default", "meaning"), rows)


def _value(value: Any) -> str:
    """Write a default as text; objects by name."""
    names = _names(value) if isinstance(value, tuple) else []
    if names:
        return ", ".join(names if len(names) < 4 else [names[0], "...", names[-1]])
    if hasattr(value, "name"):
        return str(value.name)
    return f"`{value!r}`"


def _names(entries: Iterable[Any]) -> list[str]:
    """List the names of the entries: traces and recordings, or topics of streams."""
    named = [getattr(entry, "topic", entry) for entry in entries]
    return [str(entry.name) for entry in named if hasattr(entry, "name")]
