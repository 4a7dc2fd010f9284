"""The command ``bufgym``, a thin layer: each command reads its options and calls the package that does the work.

Each command has a module whose ``add`` puts the command and its options into the parser; ``_parser`` calls each
``add``. Heavy modules are imported inside the function that needs them. A user's mistake in an option or a file gives
one line on stderr and exit code 2. Ctrl-C gives exit code 130.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import sys
from collections.abc import Sequence

from bufgym import __version__
from bufgym.cli import (
    bench,
    dataset,
    export,
    figures,
    fleet,
    leaderboard,
    listing,
    live,
    perf,
    play,
    relay,
    report,
    ros2,
    topics,
    traces,
    tune,
    warmup,
)
from bufgym.cli.listing import _LISTS, KINDS, environments
from bufgym.cli.options import Parser, split_policies
from bufgym.ground import modules
from bufgym.ground.errors import BufgymError, printable

__all__ = ["KINDS", "_LISTS", "environments", "main", "split_policies"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code."""
    options: argparse.Namespace = argparse.Namespace()
    _open_output()
    try:
        options = _parser().parse_args(arguments)
        options.command(options)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader (head, less) has gone
        _drop_output()
        return 141
    except KeyboardInterrupt:
        return _failed(f"stopped{'; the same command resumes it' if getattr(options, 'resumes', False) else ''}", 130)
    except BufgymError as error:
        return _failed(str(error))
    except OSError as error:
        file = f"{error.filename}: " if error.filename is not None else ""
        try:
            sys.stdout.flush()
        except OSError:  # a full disk behind the output
            _drop_output()
        return _failed(f"{file}{error.strerror or error}")
    except Exception as error:
        policy_file = getattr(options, "policy_file", None)
        place = modules.line_of(error, policy_file, getattr(options, "scenario_file", None))
        if place is not None:
            return _failed(f"{place}: {type(error).__name__}: {error}")
        if policy_file and type(error).__module__.startswith("numba."):
            return _failed(f"{policy_file}: a policy with compile=True that Numba cannot compile: {_gist(error)}")
        raise
    return 0


def _open_output() -> None:
    """Replace closed output by a null device, and write unencodable characters as escapes such as ``\\u2013``."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None or stream.closed:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115  (open as long as the process)
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _drop_output() -> None:
    """Discard output that the interpreter flushes at its exit."""
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), sys.stdout.fileno())


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="bufgym", description="A robot's send buffer is full: which message should go?")
    parser.add_argument("--version", action="version", version=f"bufgym {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    # In the order of --help.
    for module in (
        listing,
        bench,
        topics,
        fleet,
        report,
        tune,
        leaderboard,
        traces,
        figures,
        perf,
        play,
        live,
        ros2,
        relay,
        export,
        dataset,
        warmup,
    ):
        module.add(commands)
    return parser


# --- what went wrong, in one line ------------------------------------------------------------------------------------


def _failed(message: str, code: int = 2) -> int:
    with contextlib.suppress(OSError):
        kind = "error: " if code == 2 else ""
        print(f"bufgym: {kind}{printable(' '.join(message.split()))}", file=sys.stderr, flush=True)
    return code


def _gist(error: Exception) -> str:
    """Extract from Numba's long message the construct that it could not compile and the source line."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    # The message ends with "File "mine.py", line 4:".
    place = [line.rstrip(":") for line in lines if line.startswith("File ")][-1:]
    reason = [line for line in lines if not line.startswith(("Failed in", "During:", "File ", "-", "^", "<"))][:1]
    # The full type of a buffer has some twenty fields.
    return re.sub(r"\bBuffer\(.*\)", "Buffer", "; ".join([*reason, *place]))
