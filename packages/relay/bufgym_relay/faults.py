"""Faults of a configuration in the words of its file: line, table, key, value, and the rule that is broken.

A doubt is no fault: the relay starts, and says which rules can't do anything.
"""

import re
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import msgspec

from bufgym.utils.errors import BufgymError, unknown
from bufgym_relay.config import Config

_KINDS: Final = {
    "bool": "true or false",
    "int": "a whole number",
    "float": "a number",
    "str": "a text in quotes",
    "array": "a list, as [...]",
    "object": "a table",
}
"""TOML's words for msgspec's types."""
_AT: Final = re.compile(r"^(.*?)(?: - at `\$\.?(.*)`)?$", re.DOTALL)
_STEP: Final = re.compile(r"(\w+)|\[(\d+)\]")
_KEY: Final = re.compile(r"(?:\w+: )?(\w+)(?: = |: pattern )")
_HEADER: Final = re.compile(r"\s*\[{1,2}\s*([\w.]+)\s*\]{1,2}")


def fault(path: str | Path, table: Mapping[str, Any], error: msgspec.ValidationError) -> BufgymError:
    """The error for a file whose ``table`` could not become a configuration, as msgspec says it."""
    said, at = _AT.fullmatch(str(error)).groups()  # type: ignore[union-attr] # it matches every text
    steps: list[str | int] = [int(number) if number else name for name, number in _STEP.findall(at or "")]
    if said.startswith("Object contains unknown field"):
        steps.append(said.split("`")[1])
        rule = _unknown(steps)
    elif missing := re.fullmatch("Object missing required field `(.+)`", said):
        steps.append(missing[1])
        rule = f"needs the key {missing[1]!r}"
    elif named := _KEY.match(said):
        rule = said.removeprefix("rule: ").removeprefix(f"{steps[-1] if steps else ''}: ")
        steps.append(named[1])
    else:
        rule = _rule(said, steps, _value(table, steps))
    place = f"{path}{_line(path, steps)}"
    if len(steps) > 1:
        place += f", rule {steps[1] + 1}" if isinstance(steps[1], int) and steps[0] == "rules" else f", [{steps[0]}]"
    return BufgymError(f"{place}: {rule.removeprefix('rule: ')}")


def _unknown(steps: list[str | int]) -> str:
    """The rule for an unknown key, the last of ``steps``."""
    key = steps[-1]
    if len(steps) == 1:
        return str(unknown("key", key, Config.__struct_fields__))
    if key in Config.__struct_fields__:
        return f"unknown key {key!r} here; it must stand above the first ["
    owner = next(_structs(typing.get_type_hints(Config)[str(steps[0])]))
    return str(unknown("key", key, owner.__struct_fields__))


def _structs(kind: Any) -> Iterator[type[msgspec.Struct]]:
    """The structures in a type such as ``tuple[Rule, ...]`` or ``Tls | None``."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        yield kind
    for part in typing.get_args(kind):
        yield from _structs(part)


def _rule(said: str, steps: list[str | int], value: Any) -> str:
    """msgspec's sentence about a value as "key = value: must be ..."."""
    expected = re.match(r"Expected `(\w+)(?: \| null)?`(.*)", said)
    if expected is None:
        return f"{steps[-1]} = {_shown(value)}: {said}" if steps and said.startswith("must") else said
    kind, more = expected.groups()
    if more.startswith(" of length"):
        rule = "must not be empty"
    elif more.startswith(" matching"):
        rule = "must be one line of text"
    else:
        rule = f"must be {_KINDS.get(kind, kind)}{'' if more.startswith(',') else more}"
    if steps[0] == "rules" and len(steps) < 3 and kind in ("array", "object"):
        return "each rule must begin with [[rules]]"
    names = [str(step) for step in steps if not isinstance(step, int)]
    return f"{names[-1]} = {_shown(value)}: {rule}"


def _shown(value: Any) -> str:
    """A value as TOML has it, shortened."""
    text = f'"{value}"' if isinstance(value, str) else str(value)
    text = text.lower() if isinstance(value, bool) else text
    return text if len(text) <= 60 else f"{text[:57]}..."


def _value(table: Any, steps: list[str | int]) -> Any:
    for step in steps:
        table = table[step]
    return table


def _line(path: str | Path, steps: list[str | int]) -> str:
    """ ", line 3": of the key that ``steps`` lead to, or of its table; empty if the file has it in another form."""
    table = steps[0] if len(steps) > 1 else ""
    which = steps[1] if len(steps) > 1 and isinstance(steps[1], int) else 0
    key = next((step for step in reversed(steps) if isinstance(step, str)), "")
    here, seen, header = "", -1, 0
    for number, line in enumerate(Path(path).read_text(encoding="utf-8").splitlines(), 1):
        if begins := _HEADER.match(line):
            here = begins[1]
            seen += here == table
            if (key == here and len(steps) < 2) or (here == table and seen == which):
                header = header or number
        elif here == table and seen in (which, -1) and re.match(rf'\s*"?{re.escape(key)}"?\s*=', line):
            return f", line {number}"
    return f", line {header}" if header else ""


def doubts(config: Config) -> list[str]:
    """A sentence for each rule that lets nobody do anything, because what it needs is missing."""
    if not config.rules:
        return ["no [[rules]]: nobody may connect"]
    proofs = config.tokens is not None or (config.tls is not None and config.tls.clients)
    needs = (
        ("email", proofs, "without [tokens] or tls.clients nobody can prove it"),
        ("recorder", config.folder, "without folder nothing is recorded"),
        ("nats", config.nats, "without [nats] there are no other relays"),
        ("foxglove", config.foxglove, "without [foxglove] there is no port for it"),
    )
    return [
        f"rule {number}: {key}: {lacks}"
        for number, rule in enumerate(config.rules, 1)
        for key, there, lacks in needs
        if getattr(rule, key) and not there
    ]
