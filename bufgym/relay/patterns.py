"""Regular expressions from strangers: RE2 matches in time linear in the text, within bounded memory.

An expression of Python's own, such as ``(a+)+$``, can take longer than the sun shines; RE2 leaves out what needs that
(back references, look-around). Syntax: https://github.com/google/re2/wiki/Syntax.
"""

from __future__ import annotations

import functools
from typing import Any, Final

from bufgym.errors import BufgymError
from bufgym.relay.extra import needs

MAX_CHARACTERS: Final = 512
MAX_MEMORY_BYTES: Final = 2**18
"""Of one expression's automaton."""
_KEPT: Final = 1024
"""Expressions that stay compiled; the same one of many viewers is one."""


class Pattern:
    """A compiled expression."""

    def __init__(self, text: str, compiled: Any) -> None:
        self.text = text
        self._compiled = compiled

    def whole(self, topic: str) -> bool:
        """Whether it matches all of the topic: a rule."""
        return self._compiled.fullmatch(topic) is not None

    def part(self, topic: str) -> bool:
        """Whether it matches anywhere in it: a subscription."""
        return self._compiled.search(topic) is not None


@functools.lru_cache(_KEPT)
def pattern(text: str) -> Pattern:
    """The expression, compiled; an error for one that RE2 does not take."""
    if not isinstance(text, str) or len(text) > MAX_CHARACTERS:
        raise BufgymError(f"pattern {str(text)[:60]!r}: must be a text of at most {MAX_CHARACTERS} characters")
    with needs("re2"):
        import re2
    options = re2.Options()
    options.max_mem = MAX_MEMORY_BYTES
    options.log_errors = False
    try:
        return Pattern(text, re2.compile(text, options))
    except (re2.error, UnicodeEncodeError) as error:
        why = error.args[0].decode(errors="replace") if isinstance(error, re2.error) else "no UTF-8"
        raise BufgymError(f"pattern {text!r}: {why}") from None
