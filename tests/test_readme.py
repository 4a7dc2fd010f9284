"""What README tells users to type is there, and its policies run as printed."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

import pytest

from bufgym import cli, policies, reproduce
from bufgym.cli import main

README = (Path(__file__).resolve().parent.parent / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)
SPANS = re.findall(r"`([^`\n]+)`", re.sub(r"^```.*?^```$", "", README, flags=re.MULTILINE | re.DOTALL))


def told() -> list[list[str]]:
    """The words after ``bufgym`` of every command line."""
    lines = [line for language, block in BLOCKS if not language for line in block.splitlines()]
    return [line.partition("#")[0].split()[1:] for line in (*lines, *SPANS) if line.startswith("bufgym ")]


def test_every_command_exists() -> None:
    (commands,) = (a for a in cli._parser()._actions if isinstance(a, argparse._SubParsersAction))
    found = told()
    assert len(found) > 30 and {"list", "reproduce", "topics"} <= {words[0] for words in found}
    unknown = [words for words in found if words[0] not in commands.choices]
    for command, *words in found:
        if command not in ("list", "reproduce"):
            continue
        known = cli.KINDS if command == "list" else ("all", "NAME", *reproduce.FIGURES)
        names = " ".join(words).partition(" --")[0].split()
        unknown += [[command, name] for name in names if name not in known]
    assert not unknown


def blocks_of(file: str) -> str:
    (block,) = (block for language, block in BLOCKS if language == "python" and block.startswith(f"# {file}\n"))
    return block


@pytest.mark.parametrize(
    ("file", "name", "command"),
    [
        ("mine.py", "every-other", ["bench", "--trace", "lte-synthetic-0", "--seconds", "2"]),
        ("urgent.py", "urgent-first", ["topics", "--trace", "lte-synthetic-0"]),
    ],
)
def test_policies_run_as_printed(
    file: str, name: str, command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mine, client = tmp_path / file, tmp_path / "client.toml"
    mine.write_text(blocks_of(file))
    topics = [f'[[topic]]\nname = "{p}"\npriority = {p}\nrate_hz = 20\nsize_bytes = 200000\n' for p in (1, 2, 3)]
    client.write_text("\n".join(["duration_s = 2", *topics]))
    chosen = ["--capacity", "4", "--seeds", "1", "--policy-file", str(mine)]
    chosen += ["--policies", name, *([] if command[0] == "bench" else ["--config", str(client)])]
    try:
        assert main([*command, *chosen]) == 0
        shown = capsys.readouterr().out
        assert f"\n{name} " in shown and "invalid" not in shown
    finally:
        policies.registry._REGISTRY.pop(name, None)
