"""The command ``bufgym``. Thin: each command reads its options and calls the room that does the work.

One module a command: its ``add`` puts the command and its options into the parser, and ``_parser`` calls each ``add``.
Heavy modules are imported inside the function that needs them. A mistake of the caller's (an option, a file) ends in
one line on stderr and exit code 2; Ctrl-C in 130.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Sequence

from bufgym import __version__
from bufgym.cli import bench, export, figures, fleet, leaderboard, listing, perf, play, report, topics, traces, tune
from bufgym.cli.listing import _LISTS, KINDS, environments
from bufgym.cli.options import Parser, split_policies
from bufgym.errors import BufgymError, line_in

__all__ = ["KINDS", "_LISTS", "environments", "main", "split_policies"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit code."""
    policy_file: str | None = None
    try:
        options = _parser().parse_args(arguments)
        policy_file = getattr(options, "policy_file", None)
        options.command(options)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader (head, less) has gone; what the interpreter flushes at its exit has nowhere to go either.
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())
        return 141
    except KeyboardInterrupt:
        return 130
    except BufgymError as error:
        return _failed(str(error))
    except OSError as error:
        file = f"{error.filename}: " if error.filename is not None else ""
        return _failed(f"{file}{error.strerror or error}")
    except Exception as error:
        place = line_in(error, policy_file) if policy_file else None
        if place is not None:
            return _failed(f"{place}: {type(error).__name__}: {error}")
        if policy_file and type(error).__module__.startswith("numba."):
            return _failed(f"{policy_file}: a policy with compile=True that Numba cannot compile: {_gist(error)}")
        raise
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="bufgym", description="A robot's send buffer is full: which message should go?")
    parser.add_argument("--version", action="version", version=f"bufgym {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    # In the order in which --help shows them.
    for module in (listing, bench, topics, fleet, report, tune, leaderboard, traces, figures, perf, play, export):
        module.add(commands)
    return parser


# --- what went wrong, in one line ------------------------------------------------------------------------------------


def _failed(message: str) -> int:
    print(f"bufgym: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _gist(error: Exception) -> str:
    """The part of Numba's long message that helps: what it could not compile, and the line of the source."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    # "File "mine.py", line 4:" comes last of all.
    place = [line.rstrip(":") for line in lines if line.startswith("File ")][-1:]
    reason = [line for line in lines if not line.startswith(("Failed in", "During:", "File ", "-", "^", "<"))][:1]
    # Written out, the type of a buffer has some twenty fields.
    return re.sub(r"\bBuffer\(.*\)", "Buffer", "; ".join([*reason, *place]))
