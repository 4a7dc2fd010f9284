"""The command ``bufgym``, a thin layer: each command reads its options and calls the package that does the work.

A command is a function whose parameters are its options. ``COMMANDS`` says where each is; its module is imported when
it is called, and heavy modules inside the function that needs them. A user's mistake in an option or a file gives one
line on stderr and exit code 2. Ctrl-C gives exit code 130.
"""

import contextlib
import io
import os
import sys
import warnings
from collections.abc import Mapping, Sequence
from importlib.metadata import entry_points
from typing import Any

from cyclopts import (
    App,
    CycloptsError,
    MissingArgumentError,
    UnknownCommandError,
    UnknownOptionError,
    UnusedCliTokensError,
)

from bufgym.cli.options import OPTIONS
from bufgym.utils import __version__, modules, packages
from bufgym.utils.errors import BufgymError, TraceWarning, printable, unknown

__all__ = ["main"]

_formatwarning = warnings.formatwarning

COMMANDS: dict[str, Any] = {
    "list": "bufgym.cli.listing:listing",
    "bench": "bufgym.cli.bench:bench",
    "report": "bufgym.cli.results:report",
    "leaderboard": "bufgym.cli.results:leaderboard",
    "validate": "bufgym.cli.results:validate",
    "curves": "bufgym.cli.results:curves",
    "trace": (
        "Bandwidth traces and recordings: look at them, convert, fit, generate, fetch.",
        {
            "info": "bufgym.cli.traces:info",
            "plot": "bufgym.cli.traces:plot",
            "validate": "bufgym.cli.traces:validate",
            "convert": "bufgym.cli.traces:convert",
            "from-bag": "bufgym.cli.trace_bags:from_bag",
            "from-poses": "bufgym.cli.trace_bags:from_poses",
            "fit": "bufgym.cli.trace_fit:fit",
            "generate": "bufgym.cli.trace_generate:generate",
            "fetch": "bufgym.cli.trace_fetch:fetch",
        },
    ),
    "play": "bufgym.cli.play:play",
    "export": "bufgym.cli.export:export",
    "dataset": ("Record data sets for imitation and offline learning.", {"make": "bufgym.cli.dataset:dataset"}),
}
"""The core's commands in the order of ``--help``: where the function is, or (purpose, commands below it)."""

GROUP = packages.COMMANDS
"""Entry points of this group are commands of other packages, declared as in ``COMMANDS``; one may stand in for the
core's of its name, and do more."""


def app() -> App:
    """Make the command: the core's commands come first, then what installed packages add."""
    root = App(
        name="bufgym",
        help="A robot's send buffer is full: which message should go?",
        version=f"bufgym {__version__}",
        default_parameter=OPTIONS,
        help_format="markdown",
        exit_on_error=False,
        print_error=False,
        suppress_keyboard_interrupt=False,
        result_action="return_value",
    )
    return _with(root, COMMANDS | {entry.name: entry.load() for entry in entry_points(group=GROUP)})


def _with(parent: App, commands: Mapping[str, Any]) -> App:
    for k, (name, what) in enumerate(commands.items()):
        if isinstance(what, str):
            parent.command(what, name=name, sort_key=k)
        else:
            parent.command(_with(App(name=name, help=what[0], sort_key=k), what[1]))
    return parent


def _unknown(error: CycloptsError, command: str) -> str:
    """What is unknown; if a program or a package that is not installed has it, how to get that."""
    if command == "train":
        return 'train is a program of bufgym\'s source tree: type there "make train", or "python train.py --help"'
    if command.startswith("-"):
        return str(unknown("option", command, ["--version", "--help"]))
    message = packages.absent(GROUP, entry_points(group=GROUP).names).get(command)
    if message is None:
        return str(error)
    return f"{error} With more options {command} {message}" if command in COMMANDS else f"{command} {message}"


def _shown(root: App, words: Sequence[str]) -> App:
    """Import the commands below the one that the words name, whose help shows their purposes; ``root``."""
    part = root
    for word in words:
        if word.startswith("-") or word not in part:
            break
        part = part[word]
    part.resolved_commands()
    return root


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return the exit code."""
    _open_output()
    warnings.formatwarning = _warning
    words = sys.argv[1:] if arguments is None else arguments
    try:
        code: int | None = _shown(app(), words)(words)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader (head, less) has gone
        _drop_output()
        return 141
    except KeyboardInterrupt as stop:
        return _failed("; ".join(["stopped", *map(str, stop.args)]), 130)
    except MissingArgumentError as error:
        return _failed(_missing(error))
    except (UnknownCommandError, UnknownOptionError) as error:
        return _failed(_unknown(error, words[0]))
    except UnusedCliTokensError as error:
        return _failed(f"{' '.join(error.unused_tokens or ())}: one word too many; --help says what the command takes")
    except (BufgymError, CycloptsError) as error:
        return _failed(str(error))
    except OSError as error:
        file = f"{error.filename}: " if error.filename is not None else ""
        try:
            sys.stdout.flush()
        except OSError:  # a full disk behind the output
            _drop_output()
        return _failed(f"{file}{error.strerror or error}")
    except Exception as error:
        place = modules.line_of(error)
        if place is not None:
            return _failed(f"{place}: {type(error).__name__}: {error}")
        raise
    return code or 0


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


def _warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """Write a doubt about a file as one line, and any other warning as Python does."""
    if category is TraceWarning:
        return f"bufgym: warning: {message}\n"
    return _formatwarning(message, category, filename, lineno, line)


def _failed(message: str, code: int = 2) -> int:
    with contextlib.suppress(OSError):
        kind = "error: " if code == 2 else ""
        print(f"bufgym: {kind}{printable(' '.join(message.split()))}", file=sys.stderr, flush=True)
    return code


def _missing(error: MissingArgumentError) -> str:
    """Tell an argument that is not there from an option without its value."""
    argument = error.argument
    if argument is None or argument.tokens or error.keyword is not None:
        return str(error)
    return f"{' '.join(error.command_chain or ('bufgym',))} needs {argument.name}"
