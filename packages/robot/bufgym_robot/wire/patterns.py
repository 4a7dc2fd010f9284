"""Regular expressions from untrusted clients, matched by RE2 in linear time and bounded memory.

Python's own ``re`` can take exponential time on an expression such as ``(a+)+$``. RE2 lacks the features that need
this, such as back references and look-around. Its syntax is at https://github.com/google/re2/wiki/Syntax.

Clients read patterns too, in Python and JavaScript. So the relay takes only what means the same to all of them.
"""

import functools
import re
from typing import Any, Final, NamedTuple

from bufgym.utils.errors import BufgymError

MAX_CHARACTERS: Final = 512
MAX_MEMORY_BYTES: Final = 2**18  # Memory limit of one expression's automaton
_STEPS: Final = 32  # Instructions of RE2 that count for one subscription; each may cost a step per character
_KEPT: Final = 1024  # expressions kept compiled; viewers with the same expression share it
_ESCAPE: Final = re.compile(r"\\.", re.DOTALL)
_CLASS: Final = re.compile(r"\[\^?[^\]]+\]")
_UNLIKE: Final = {
    r"\\[Aa]": "write ^ or the character",
    r"\[\^?\]|\[.*\[|\[.*(--|&&|~~|\|\|)": r"in brackets, write \[ \] \- \& \~ \| with their backslash",
    r"\(\?(?!:)": "a group must begin with ( or (?:",
    r"[*+?}]\+": "+ must not follow another repetition",
    r"\{,": "write {0, for {,",
}
"""What RE2, Python and JavaScript read in different ways: in escapes, in brackets, and in the rest."""


class Pattern(NamedTuple):
    """A compiled expression."""

    text: str
    compiled: Any

    @property
    def cost(self) -> int:
        """How many subscriptions it counts for, by the length of RE2's program."""
        return 1 + int(self.compiled.programsize) // _STEPS

    def whole(self, topic: str) -> bool:
        """Whether it matches the whole topic, as rules do."""
        return self.compiled.fullmatch(topic) is not None

    def part(self, topic: str) -> bool:
        """Whether it matches anywhere in the topic, as subscriptions do."""
        return self.compiled.search(topic) is not None


def escaped(text: str) -> str:
    """Write a text as an expression that matches it alone, in all three languages."""
    return re.sub(r"[.^$*+?{}\[\]\\|()]", r"\\\g<0>", text)


def exactly(topic: str) -> str:
    """Write the expression that only this whole topic matches."""
    return f"^{escaped(topic)}$"


def topic_of(text: str) -> str | None:
    """Give the topic of which ``exactly`` made an expression; None for any other."""
    topic = re.sub(r"\\(.)", r"\1", text[1:-1])
    return topic if exactly(topic) == text else None


@functools.lru_cache(_KEPT)
def for_client(text: str) -> re.Pattern[str]:
    """Compile an expression with Python alone; raise an error if it is not one of the common language."""
    if not isinstance(text, str) or len(text) > MAX_CHARACTERS:
        raise BufgymError(f"pattern {str(text)[:60]!r}: must be a text of at most {MAX_CHARACTERS} characters")
    bare = _ESCAPE.sub("_", text)
    parts = [*_ESCAPE.findall(text), *_CLASS.findall(bare), _CLASS.sub("_", bare)]
    for unlike, rule in _UNLIKE.items():
        if any(re.search(unlike, part) for part in parts):
            raise BufgymError(f"pattern {text!r}: {rule}")
    try:
        return re.compile(text, re.ASCII)
    except (re.error, OverflowError, RecursionError) as error:
        raise BufgymError(f"pattern {text!r}: {error}") from None


@functools.lru_cache(_KEPT)
def pattern(text: str) -> Pattern:
    """Compile an expression; raise an error unless RE2 and all clients accept it."""
    for_client(text)
    import re2

    options = re2.Options()
    options.max_mem = MAX_MEMORY_BYTES
    options.log_errors = False
    try:
        return Pattern(text, re2.compile(text, options))
    except (re2.error, UnicodeEncodeError) as error:
        why = error.args[0].decode(errors="replace") if isinstance(error, re2.error) else "no UTF-8"
        raise BufgymError(f"pattern {text!r}: {why}") from None
