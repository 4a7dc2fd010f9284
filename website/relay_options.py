"""The page of a relay's rules and options, from the classes of its configuration.

``python -m website.relay_options`` writes it; a test compares.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import msgspec
from msgspec.structs import FieldInfo, fields

from bufgym.model.documented import below_fields
from bufgym_relay.config import Config, Foxglove, Limits, Nats, Rule, StoreLimits, Tls, Tokens
from website.markdown import code, table

PAGE: Final = Path(__file__).resolve().parent.parent / "docs/guide/relay-options.md"

HEAD: Final = """# A relay's rules and options

A relay reads one TOML file, as [`examples/relay.toml`](../../examples/relay.toml). File names in it are relative to it.
`bufgym relay serve --config relay.toml --check` names the first fault and idle rules. On SIGHUP a relay rereads rules,
certificates and the issuer's keys, and says which other changes need a restart.
"""

RULES: Final = """What no rule allows is denied. A rule has one identity (the first five keys) and
allows `send`, `receive` or both. [RE2](https://github.com/google/re2/wiki/Syntax) patterns match the
whole topic. Whoever may send `command` to a robot may stop and release it. The first rule that lets a message be sent
gives its `command_s` and `speed`.
"""

ROTATION: Final = "`[audit]` and `[recording]` take `bytes` of a file and the number of `files`."

SECTIONS: Final[tuple[tuple[str, str, dict[str, type[Any]]], ...]] = (
    ("Rules", RULES, {"": Rule}),
    ("Top level", "", {"": Config}),
    ("`[limits]` of one identity", "", {"": Limits}),
    ("`[store]` of messages that may not be lost", "", {"": StoreLimits}),
    ("Other tables", ROTATION + "\n", {"tls.": Tls, "tokens.": Tokens, "nats.": Nats, "foxglove.": Foxglove}),
)
"""Title, text, and the tables of each section by the prefix of their keys."""


def page() -> str:
    """The whole page."""
    return "\n".join([HEAD, *(part for section in SECTIONS for part in _section(*section))]).rstrip() + "\n"


def _section(title: str, about: str, tables: dict[str, type[Any]]) -> Iterator[str]:
    yield f"## {title}\n"
    if about:
        yield about
    rows = [
        (f"`{prefix}{field.name}`", code(meaning), _default(field))
        for prefix, kind in tables.items()
        for field, meaning in zip(*_documented(kind), strict=True)
    ]
    text = table(("key", "meaning", "default"), rows)
    yield re.sub(r"^\| | \|$", "", text, flags=re.MULTILINE).replace("| ---:", "| ---") + "\n"


def _documented(kind: type[Any]) -> tuple[list[FieldInfo], list[str]]:
    """The fields that are no tables themselves, and their meanings."""
    meanings = below_fields(kind)
    keys = [field for field in fields(kind) if not _is_table(field)]
    return keys, [meanings[field.name] for field in keys]


def _is_table(field: FieldInfo) -> bool:
    """Whether the field is a table of the configuration, or a list of them."""
    kinds = field.type, *getattr(field.type, "__args__", ())
    return any(isinstance(kind, type) and issubclass(kind, msgspec.Struct) for kind in kinds)


def _default(field: FieldInfo) -> str:
    """Write a default as in TOML."""
    if field.required:
        return "required"
    default = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
    if default is None or default in ("", ()):
        return "none"
    text = f"{default:_}" if type(default) is int and default > 9_999 else json.dumps(default)
    # In a table, some readers of Markdown show the backslash of an escaped bar.
    return f"<code>{text.replace('|', '&#124;')}</code>" if "|" in text else f"`{text}`"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
