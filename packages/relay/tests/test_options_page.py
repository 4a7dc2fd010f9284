"""The page of rules and options has every key of the configuration, as the code has it."""

import re
from collections.abc import Iterator
from typing import Any

import msgspec
from msgspec.structs import fields

from bufgym_relay.config import Config, Rotation
from website import relay_options


def keys(kind: type[Any], prefix: str = "") -> Iterator[str]:
    """Every key of a table and of the tables in it, by names as ``tokens.client``; each table of rotation is alike."""
    for field in fields(kind):
        parts = [part for part in (field.type, *getattr(field.type, "__args__", ())) if isinstance(part, type)]
        table = next((part for part in parts if issubclass(part, msgspec.Struct)), None)
        if table is None:
            yield prefix + field.name
        elif table is not Rotation:
            inside = field.name in ("rules", "limits", "store")  # sections of their own, so without a prefix
            yield from keys(table, "" if inside else f"{field.name}.")


def test_the_page_is_what_the_code_says() -> None:
    page = relay_options.page()
    written = relay_options.PAGE.read_text(encoding="utf-8")
    assert written == page, "run python -m website.relay_options"
    rows = [line.split("`")[1] for line in page.splitlines() if line.startswith("`") and " | " in line]
    assert sorted(rows) == sorted(keys(Config)) and "limits.topics" not in rows and "tokens.client" in rows
    # By hand: two defaults as TOML has them, one that must be given, and one without a value.
    for key, default in (("port", "`7420`"), ("folder", "none"), ("tls.key", "required"), ("window", "`5`")):
        assert re.search(rf"^`{key}` \| [^|]+ \| ?{default}$", page, re.MULTILINE), key
    assert "(map&#124;tf_static)" in page  # a bar ends a cell
