"""Regular expressions from untrusted clients, matched by RE2 in linear time and bounded memory.

Python's own ``re`` can take exponential time on an expression such as ``(a+)+$``. RE2 lacks the features that need
this, such as back references and look-around. Its syntax is at https://github.com/google/re2/wiki/Syntax.
"""

import functools
from typing import Any, Final, NamedTuple

from bufgym.ground.errors import BufgymError

MAX_CHARACTERS: Final = 512
MAX_MEMORY_BYTES: Final = 2**18  # Memory limit of one expression's automaton
_KEPT: Final = 1024  # expressions kept compiled; viewers with the same expression share it


class Pattern(NamedTuple):
    """A compiled expression."""

    text: str
    compiled: Any

    def whole(self, topic: str) -> bool:
        """Whether it matches the whole topic, as rules do."""
        return self.compiled.fullmatch(topic) is not None

    def part(self, topic: str) -> bool:
        """Whether it matches anywhere in the topic, as subscriptions do."""
        return self.compiled.search(topic) is not None


@functools.lru_cache(_KEPT)
def pattern(text: str) -> Pattern:
    """Compile an expression; raise an error if RE2 does not accept it."""
    if not isinstance(text, str) or len(text) > MAX_CHARACTERS:
        raise BufgymError(f"pattern {str(text)[:60]!r}: must be a text of at most {MAX_CHARACTERS} characters")
    import re2

    options = re2.Options()
    options.max_mem = MAX_MEMORY_BYTES
    options.log_errors = False
    try:
        return Pattern(text, re2.compile(text, options))
    except (re2.error, UnicodeEncodeError) as error:
        why = error.args[0].decode(errors="replace") if isinstance(error, re2.error) else "no UTF-8"
        raise BufgymError(f"pattern {text!r}: {why}") from None
