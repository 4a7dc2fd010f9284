"""What the commands share: the parser, the types of options, policies by name and from files, columns to print."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn, TypeAlias

from bufgym.errors import BufgymError, printable


class Parser(argparse.ArgumentParser):
    """A parser that raises BufgymError, like every other mistake of the caller's."""

    def error(self, message: str) -> NoReturn:
        raise BufgymError(f"{message} (see {self.prog} --help)")


MAX_EPISODES = 100_000
"""On each trace. Each is a row of every policy and capacity, all of them held in memory."""

Commands: TypeAlias = "argparse._SubParsersAction[Parser]"
"""What ``add_subparsers`` returns: where commands are added."""


def command(commands: Commands, name: str, function: Callable[[argparse.Namespace], None], help: str) -> Parser:
    """Add the command ``name``, which calls ``function`` with its options; its own parser, to add them to."""
    parser = commands.add_parser(name, help=help, description=help[0].upper() + help[1:] + ".")
    parser.set_defaults(command=function)
    return parser


# --- types of options ------------------------------------------------------------------------------------------------


def number(text: str) -> float:
    """A finite number."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text!r}: must be a finite number")
    return value


def positive(text: str) -> float:
    """A number > 0."""
    value = number(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"{text}: must be a number > 0")
    return value


def least_0(text: str) -> float:
    """A number >= 0."""
    value = number(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text}: must be a number >= 0")
    return value


def count(text: str) -> int:
    """A whole number >= 1."""
    value = natural(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number >= 1")
    return value


def episodes(text: str) -> int:
    """How many seeds: a whole number from 1 to ``MAX_EPISODES``."""
    number = count(text)
    if number > MAX_EPISODES:
        raise argparse.ArgumentTypeError(f"{text}: must be at most {MAX_EPISODES}")
    return number


def natural(text: str) -> int:
    """A whole number >= 0."""
    try:
        value = int(text)
    except ValueError:
        value = -1
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number >= 0")
    return value


def capacities(text: str) -> list[int]:
    """Whole numbers >= 1, no two alike: ``"4,8,16"``."""
    numbers = [count(part) for part in text.split(",")]
    for capacity in numbers:
        if numbers.count(capacity) > 1:
            raise argparse.ArgumentTypeError(f"{text}: {capacity} is given more than once")
    return numbers


def split_policies(text: str) -> list[str]:
    """``"afr,decimate:every=2,random"`` -> its three policies; a setting belongs to the policy before it."""
    specs: list[str] = []
    for part in text.split(","):
        if "=" in part and ":" not in part and specs:
            specs[-1] += f",{part}"
        else:
            specs.append(part.strip())
    return specs


def policies_option(parser: argparse._ActionsContainer, default: str) -> None:
    """Add the option ``--policies``; ``policy_specs`` reads it."""
    parser.add_argument(
        "--policies",
        nargs="+",
        metavar="A,B:x=1,C",
        help=f"policies, with settings as in decimate:every=2 (default: {default})",
    )


def policy_specs(texts: Sequence[str] | None) -> list[str]:
    """The policies that ``--policies`` names, with commas or as several words; none if it was not given."""
    return [spec for text in texts or () for spec in split_policies(text)]


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
    if path is None:
        return
    import importlib.util

    if not Path(path).is_file():
        raise BufgymError(f"{path}: no such file (--policy-file)")
    spec = importlib.util.spec_from_file_location(f"bufgym_policy_file_{Path(path).stem}", path)
    if spec is None or spec.loader is None:
        raise BufgymError(f"{path}: must be a Python file, named .py")
    module = importlib.util.module_from_spec(spec)
    # Compiled functions are pickled by their module's name.
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        raise BufgymError(f"{path}, line {error.lineno}: {error.msg}") from None


# --- output ----------------------------------------------------------------------------------------------------------


def columns(lines: Sequence[Sequence[str]]) -> str:
    """Left-aligned columns, indented; the last is not padded."""
    lines = [list(map(printable, line)) for line in lines]
    widths = [max((len(line[c]) for line in lines), default=0) for c in range(max(map(len, lines), default=0))]
    return "\n".join(
        "  " + "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines
    )
