"""A name with settings in one text, as in ``"decimate:every=2"`` or ``"lte:rate_hz=5,motion=none"``."""

import re
from collections.abc import Callable
from typing import Any

from bufgym.utils.errors import BufgymError


def named_settings(what: str, text: str, read: Callable[[str], Any] = float) -> tuple[str, dict[str, Any]]:
    """Split into the name and its settings, each value as ``read`` makes it; ``what`` is the thing, for the message.

    A comma begins the next setting only before ``parameter=``, so a value may hold commas. A name may hold a colon, as
    in ``"module:function:robots=3"``.
    """
    split = re.match(r"([^=]*?):(?=\s*[A-Za-z_]\w*\s*=)", text)
    name, settings = (split[1], text[split.end() :]) if split else (text.partition(":")[0], text.partition(":")[2])
    found: dict[str, Any] = {}
    for setting in filter(None, re.split(r",(?=\s*[A-Za-z_]\w*=)", settings)):
        key, _, value = setting.partition("=")
        try:
            found[key.strip()] = read(value)
        except ValueError:
            raise BufgymError(f"{what} {text!r}: {setting!r} is not of the form parameter=number") from None
    return name, found
