"""Reader of untrusted JSON files; its errors name the file, the field and the rule."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bufgym.ground import strict_json
from bufgym.ground.errors import BufgymError, where
from bufgym.ground.files import read_utf8

MAX_JSON_BYTES = 64 * 2**20  # Size limit; a timeline of 100,000 messages has some 20 MB


def read_object(path: Path) -> dict[str, Any]:
    """Read the object in a file; numbers must be finite."""
    text = read_utf8(path, MAX_JSON_BYTES)
    try:
        content = strict_json.loads(text)
    except RecursionError:
        raise BufgymError(f"{path}: nested too deep") from None
    except json.JSONDecodeError as error:
        raise BufgymError(where(path, error.lineno, None, f"must be JSON: {error.msg}")) from None
    except ValueError as error:
        raise BufgymError(f"{path}: {str(error).partition(';')[0]}") from None
    if not isinstance(content, dict):
        raise BufgymError(f"{path}: must be a JSON object")
    return content


def check(path: Path, place: str, content: Any, kinds: Mapping[str, Any]) -> None:
    """Check that the object ``content``, found at ``place``, has every entry of ``kinds`` with the right kind."""
    if not isinstance(content, dict):
        raise BufgymError(f"{path}: {place} must be an object")
    for name, kind in kinds.items():
        field = f"{place}.{name}" if place else name
        if name not in content:
            raise BufgymError(f"{path}: no {field}")
        # In Python True is an int, but here it is no number.
        if not isinstance(content[name], kind) or isinstance(content[name], bool):
            words = {str: "text", list: "a list", dict: "an object", int: "a whole number"}.get(kind, "a number")
            raise BufgymError(where(path, None, content[name], f"must be {words}", field=field))
        if kind is str and not content[name].isprintable():
            raise BufgymError(where(path, None, content[name], "must be one line of text", field=field))
