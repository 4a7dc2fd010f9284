"""JSON files from outside: read and checked, with errors that name the file, the field and the rule."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bufgym.errors import BufgymError, where


def read_object(path: Path) -> dict[str, Any]:
    """The object that the file holds; numbers must be finite."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse)
    except UnicodeDecodeError:
        raise BufgymError(f"{path}: must be UTF-8 text") from None
    except json.JSONDecodeError as error:
        raise BufgymError(where(path, error.lineno, None, f"must be JSON: {error.msg}")) from None
    except ValueError as error:
        raise BufgymError(f"{path}: {error}") from None
    if not isinstance(content, dict):
        raise BufgymError(f"{path}: must be a JSON object")
    return content


def _refuse(constant: str) -> None:
    raise ValueError(f"{constant}: numbers must be finite")


def check(path: Path, place: str, content: Any, kinds: Mapping[str, Any]) -> None:
    """Every entry of ``kinds`` is in the object ``content``, and of its kind; ``place`` says where the object is."""
    if not isinstance(content, dict):
        raise BufgymError(f"{path}: {place} must be an object")
    for name, kind in kinds.items():
        field = f"{place}.{name}" if place else name
        if name not in content:
            raise BufgymError(f"{path}: no {field}")
        if not isinstance(content[name], kind):
            words = {str: "text", list: "a list", dict: "an object", int: "a whole number"}.get(kind, "a number")
            raise BufgymError(where(path, None, content[name], f"must be {words}", field=field))
