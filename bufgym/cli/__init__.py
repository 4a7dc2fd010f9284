"""The command ``bufgym``, a thin layer: each command reads its options and calls the package that does the work.

A command is a function whose parameters are its options. ``COMMANDS`` says where each is; its module is imported when
it is called, and heavy modules inside the function that needs them. A user's mistake in an option or a file gives one
line on stderr and exit code 2. Ctrl-C gives exit code 130.
"""

import contextlib
import io
import os
import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from cyclopts import App, CycloptsError, MissingArgumentError

from bufgym.cli.options import OPTIONS
from bufgym.ground import __version__, modules
from bufgym.ground.errors import BufgymError, TraceWarning, printable

__all__ = ["app", "main"]

_formatwarning = warnings.formatwarning

COMMANDS: dict[str, Any] = {
    "list": "cli.listing:listing",
    "bench": "cli.bench:bench",
    "topics": "cli.topics:topics",
    "fleet": "cli.topics:fleet",
    "report": "cli.results:report",
    "leaderboard": "cli.results:leaderboard",
    "validate": "cli.results:validate",
    "trace": (
        "Bandwidth traces and recordings: look at them, convert, fit, generate, fetch.",
        {
            "info": "cli.traces:info",
            "plot": "cli.traces:plot",
            "validate": "cli.traces:validate",
            "convert": "cli.traces:convert",
            "from-bag": "cli.trace_bags:from_bag",
            "from-poses": "cli.trace_bags:from_poses",
            "fit": "cli.trace_fit:fit",
            "generate": "cli.trace_generate:generate",
            "fetch": "cli.trace_fetch:fetch",
        },
    ),
    "reproduce": "papers.commands:reproduce",
    "play": "cli.play:play",
    "live": (
        "Policies on real sockets, beside the simulator.",
        {
            "send": "robot.commands:send",
            "receive": "robot.commands:receive",
            "link": "robot.commands:link",
            "validate": "robot.checks:validate",
            "view": "robot.checks:view",
            "replay": "robot.checks:replay",
            "cost": "robot.cost:cost",
        },
    ),
    "ros2": (
        "A relay between ROS 2 networks, its uplink under a policy.",
        {"send": "robot.ros2.commands:send", "receive": "robot.ros2.commands:receive"},
    ),
    "relay": (
        "A server for fleets: robots and viewers meet there.",
        {"serve": "relay.commands:serve", "robot": "relay.commands:robot", "foxglove": "relay.commands:foxglove"},
    ),
    "export": "robot.c.commands:export",
    "dataset": ("Record data sets for imitation and offline learning.", {"make": "cli.dataset:dataset"}),
    "warmup": "cli.results:warmup",
}
"""Commands in the order of ``--help``: where the function is, or (purpose, commands below it)."""


def app() -> App:
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
    return _with(root, COMMANDS)


def _with(parent: App, commands: Mapping[str, Any]) -> App:
    for k, (name, what) in enumerate(commands.items()):
        if isinstance(what, str):
            parent.command(f"bufgym.{what}", name=name, sort_key=k)
        else:
            parent.command(_with(App(name=name, help=what[0], sort_key=k), what[1]))
    return parent


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
    try:
        words = sys.argv[1:] if arguments is None else arguments
        code: int | None = _shown(app(), words)(words)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader (head, less) has gone
        _drop_output()
        return 141
    except KeyboardInterrupt as stop:
        return _failed("; ".join(["stopped", *map(str, stop.args)]), 130)
    except MissingArgumentError as error:
        return _failed(_missing(error))
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
        if modules.FILES and type(error).__module__.startswith("numba."):
            return _failed(f"{modules.FILES[-1]}: a policy with compile=True that Numba cannot compile: {_gist(error)}")
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


def _gist(error: Exception) -> str:
    """Extract from Numba's long message the construct that it could not compile and the source line."""
    plain = re.sub(r"\x1b\[[\d;]*m", "", str(error))
    lines = [line.strip() for line in plain.splitlines() if line.strip()]
    # The message ends with "File "mine.py", line 4:".
    place = [line.rstrip(":") for line in lines if line.startswith("File ")][-1:]
    reason = [line for line in lines if not line.startswith(("Failed in", "During:", "File ", "-", "^", "<"))][:1]
    # The full type of a buffer has some twenty fields.
    return re.sub(r"\bBuffer\(.*\)", "Buffer", "; ".join([*reason, *place]))
