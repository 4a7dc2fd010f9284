"""The command ``bufgym``. Thin: each command reads its options and calls the room that does the work.

One module a command: its ``add`` puts the command and its options into the parser, and ``_parser`` calls each ``add``.
Whatever is heavy is imported inside the function that needs it. A mistake of the caller's (an option, a file) ends in
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
    files: list[str] = []
    try:
        options = _parser().parse_args(arguments)
        files = [options.policy_file] if getattr(options, "policy_file", None) else []
        options.command(options)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader (head, less) has gone; what the interpreter flushes at its end has nowhere to go either.
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())
        return 141
    except KeyboardInterrupt:
        return 130
    except BufgymError as error:
        return _failed(str(error))
    except OSError as error:
        named = f"{error.filename}: " if error.filename is not None else ""
        return _failed(f"{named}{error.strerror or error}")
    except Exception as error:
        place = next(filter(None, (line_in(error, file) for file in files)), None)
        if place is None and files and _from_numba(error):
            return _failed(f"{files[0]}: a policy with compile=True that Numba cannot compile: {_gist(error)}")
        if place is None:
            raise
        return _failed(f"{place}: {type(error).__name__}: {error}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="bufgym", description="A robot's send buffer is full: which message should go?")
    parser.add_argument("--version", action="version", version=f"bufgym {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    # In the order in which --help shows them.
    listing.add(commands)
    bench.add(commands)
    topics.add(commands)
    fleet.add(commands)
    report.add(commands)
    tune.add(commands)
    leaderboard.add(commands)
    traces.add(commands)
    figures.add(commands)
    perf.add(commands)
    play.add(commands)
    export.add(commands)
    return parser


# --- what went wrong, in one line ------------------------------------------------------------------------------------


def _failed(message: str) -> int:
    print(f"bufgym: error: {' '.join(message.split())}", file=sys.stderr)
    return 2


def _from_numba(error: Exception) -> bool:
    return type(error).__module__.startswith("numba.")


def _gist(error: Exception) -> str:
    """The part of Numba's many lines that tells most: what it did not know, and the line of the source."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    # "File "mine.py", line 4:" comes last of all.
    place = [line.rstrip(":") for line in lines if line.startswith("File ")][-1:]
    telling = [line for line in lines if not line.startswith(("Failed in", "During:", "File ", "-", "^", "<"))][:1]
    # Written out, the type of a buffer has some twenty fields.
    return re.sub(r"\bBuffer\(.*\)", "Buffer", "; ".join([*telling, *place]))
