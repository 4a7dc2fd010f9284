"""Parts shared by commands: the parser, types of options, policies by name and from files, printed columns."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from typing import Any, NoReturn, TypeAlias, TypeVar

from bufgym.ground import modules
from bufgym.ground.errors import BufgymError, printable

T = TypeVar("T")


class Parser(argparse.ArgumentParser):
    """A parser that raises BufgymError, as for any other mistake of the user."""

    def error(self, message: str) -> NoReturn:
        raise BufgymError(f"{message} (see {self.prog} --help)")


MAX_EPISODES = 100_000
"""Limit on episodes of each trace; memory holds a row for each, times policies and capacities."""

Commands: TypeAlias = "argparse._SubParsersAction[Parser]"
"""Result of ``add_subparsers``, to which commands are added."""


def command(commands: Commands, name: str, function: Callable[[argparse.Namespace], None], help: str) -> Parser:
    """Add the command ``name``, which calls ``function`` with its options; return its parser."""
    parser = commands.add_parser(name, help=help, description=help[0].upper() + help[1:] + ".")
    parser.set_defaults(command=function)
    return parser


# --- types of options ------------------------------------------------------------------------------------------------


def _checked(convert: Callable[[str], T], holds: Callable[[T], bool], rule: str) -> Callable[[str], T]:
    """Make the type of an option: it converts the text, tests it with ``holds``, and names ``rule`` in errors."""

    def parse(text: str) -> T:
        try:
            value = convert(text)
        except ValueError:
            value = None
        if value is None or not holds(value):
            raise argparse.ArgumentTypeError(f"{text}: must be {rule}")
        return value

    return parse


number = _checked(float, math.isfinite, "a finite number")
positive = _checked(float, lambda number: 0 < number < math.inf, "a number > 0")
least_0 = _checked(float, lambda number: 0 <= number < math.inf, "a number >= 0")
count = _checked(int, lambda number: number >= 1, "a whole number >= 1")
natural = _checked(int, lambda number: number >= 0, "a whole number >= 0")


def episodes(text: str) -> int:
    """Parse a number of seeds, an integer from 1 to ``MAX_EPISODES``."""
    seeds = count(text)
    if seeds > MAX_EPISODES:
        raise argparse.ArgumentTypeError(f"{text}: must be at most {MAX_EPISODES}")
    return seeds


def capacities(text: str) -> list[int]:
    """Parse distinct integers >= 1, as in ``"4,8,16"``."""
    numbers = [count(part) for part in text.split(",")]
    for capacity in numbers:
        if numbers.count(capacity) > 1:
            raise argparse.ArgumentTypeError(f"{text}: {capacity} is given more than once")
    return numbers


def split_policies(text: str) -> list[str]:
    """Split a list such as ``"afr,decimate:every=2,random"``; a setting belongs to the policy before it."""
    specs: list[str] = []
    for part in text.split(","):
        if "=" in part and ":" not in part and specs:
            specs[-1] += f",{part}"
        else:
            specs.append(part.strip())
    return specs


SOURCES = (
    "; also mine.safetensors, mine.zip of stable-baselines3 or sb3-contrib, and module:function (a policy, or what"
    " makes one; from the current folder too): a zip and a module run code, so use only what you trust"
)
"""Help text on sources that ``--policies`` takes besides names, in commands that use ``loaded``."""


def policies_option(parser: argparse._ActionsContainer, default: str, also: str = "") -> None:
    """Add the option ``--policies``, which ``policy_specs`` or ``loaded`` reads."""
    parser.add_argument(
        "--policies",
        nargs="+",
        metavar="A,B:x=1,C",
        help=f"policies, with settings as in decimate:every=2 (default: {default}){also}",
    )


def policy_specs(texts: Sequence[str] | None) -> list[str]:
    """List the policies of ``--policies``, separated by commas or spaces; empty if it was not given."""
    return [spec for text in texts or () for spec in split_policies(text)]


def loaded(texts: Sequence[str] | None) -> tuple[list[str], tuple[str, ...]]:
    """Register the policies of ``--policies``; return their names and the words that had to be loaded."""
    from bufgym.benchmark import sources

    words = policy_specs(texts)
    for word in words:
        if word.endswith(".py"):
            raise BufgymError(f"--policies {word}: a Python file; --policy-file {word} registers its policies")
    found = tuple(word for word in words if sources.is_source(word))
    return [sources.load(word) if word in found else word for word in words], found


def given(options: argparse.Namespace, names: tuple[str, ...]) -> dict[str, Any]:
    """Select the options that the user gave."""
    values = {name: getattr(options, name) for name in names}
    return {name: value for name, value in values.items() if value is not None and value is not False}


def refuse(options: argparse.Namespace, names: tuple[str, ...], why: str) -> None:
    """Raise the error ``--name why`` for the first of these options that the user gave."""
    for name in given(options, names):
        raise BufgymError(f"--{name.replace('_', '-')} {why}")


# --- a user's own policies -------------------------------------------------------------------------------------------


def policy_file(parser: argparse._ActionsContainer) -> None:
    """Add the option ``--policy-file``; ``load_policies`` runs the file."""
    parser.add_argument(
        "--policy-file",
        metavar="FILE.py",
        help="a Python file that registers policies of your own; its code is run, so use only files you trust",
    )


def load_policies(path: str | None) -> None:
    """Run the user's Python file, which registers policies."""
    if path is not None:
        modules.run_file(path, "--policy-file")


# --- output ----------------------------------------------------------------------------------------------------------


def columns(lines: Sequence[Sequence[str]]) -> str:
    """Align columns to the left, indented; the last is not padded."""
    lines = [list(map(printable, line)) for line in lines]
    widths = [max((len(line[c]) for line in lines), default=0) for c in range(max(map(len, lines), default=0))]
    return "\n".join(
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    )
