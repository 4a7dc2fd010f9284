"""JSON as its standard has it: Python's parser also takes NaN and Infinity, and makes infinity of ``1e400``."""

import json
import math
from typing import Any, NoReturn


class Decoder(json.JSONDecoder):
    """Raises ValueError for a number that is not finite."""

    def __init__(self) -> None:
        super().__init__(parse_constant=_refuse, parse_float=_finite)


def loads(text: str | bytes) -> Any:
    """Parse JSON; raise ValueError for a number that is not finite."""
    return json.loads(text, cls=Decoder)


def _finite(digits: str) -> float:
    number = float(digits)
    return number if math.isfinite(number) else _refuse(digits[:20])


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant}: numbers must be finite")
