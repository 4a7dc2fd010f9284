"""The page of the command line, from its parsers."""

from __future__ import annotations

import argparse
import os

from bufgym import cli


def page() -> str:
    """Every command with its help."""
    lines = ["# Command line", "Each command's `--help` prints what stands here."]
    for name, parser in _commands(cli._parser()):
        lines += [f"## {name}" if " " not in name else f"### {name}", f"```text\n{_help(parser)}\n```"]
    return "\n\n".join(lines)


def _commands(parser: argparse.ArgumentParser, before: str = "bufgym") -> list[tuple[str, argparse.ArgumentParser]]:
    """List (name, parser) of every command below this one, each followed by its own subcommands."""
    found = []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, child in action.choices.items():
                path = name if before == "bufgym" else f"{before} {name}"
                found += [(path, child), *_commands(child, path)]
    return found


def _help(parser: argparse.ArgumentParser) -> str:
    width = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "84"  # argparse reads the width here; 84 fits beside the menu
    try:
        return parser.format_help().rstrip()
    finally:
        os.environ.pop("COLUMNS")
        if width is not None:
            os.environ["COLUMNS"] = width
