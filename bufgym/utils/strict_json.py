"""JSON as its standard has it: Python's parser also takes NaN and Infinity, and makes infinity of ``1e400``.

``read_object`` and ``check`` read untrusted files; their errors name the file, the field and the rule.
"""

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NoReturn

from bufgym.utils.errors import BufgymError, where
from bufgym.utils.files import read_utf8

MAX_JSON_BYTES = 64 * 2**20  # Size limit; a timeline of 100,000 messages has some 20 MB


class Decoder(json.JSONDecoder):
    """Raises ValueError for a number that is not finite."""

    def __init__(self, pairs: Callable[[list[tuple[str, Any]]], dict[str, Any]] | None = None) -> None:
        """``pairs`` makes an object of its members, which may share a name; by default the last one counts."""
        super().__init__(parse_constant=_refuse, parse_float=_finite, object_pairs_hook=pairs)


def loads(text: str | bytes) -> Any:
    """Parse JSON; raise ValueError for a number that is not finite."""
    return json.loads(text, cls=Decoder)


def _finite(digits: str) -> float:
    number = float(digits)
    return number if math.isfinite(number) else _refuse(digits[:20])


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant}: numbers must be finite")


def read_object(path: Path) -> dict[str, Any]:
    """Read the object in a file; numbers must be finite."""
    text = read_utf8(path, MAX_JSON_BYTES)
    try:
        content = loads(text)
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
