"""Packages beside the core: it names none of them, they declare what they add, and what is missing says so."""

import importlib
import re
import tomllib
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from cli_cases import Capsys, Patch, fails, shown

import bufgym
from bufgym import cli

REPO = Path(__file__).resolve().parent.parent
PACKAGES = {file.parent.name: file for file in sorted((REPO / "packages").glob("*/pyproject.toml"))}


def declared(name: str) -> dict[str, Any]:
    project: dict[str, Any] = tomllib.loads(PACKAGES[name].read_text(encoding="utf-8"))["project"]
    return project


def functions(what: Any) -> list[str]:
    """Where the functions of a command and of the commands below it are."""
    return [what] if isinstance(what, str) else [place for below in what[1].values() for place in functions(below)]


def test_the_core_names_no_package() -> None:
    """Were one of them taken away, no line of the core would have to change."""
    sources = [path for path in (REPO / "bufgym").rglob("*") if path.suffix in (".py", ".toml", ".json", ".html")]
    assert len(sources) > 150
    names = re.compile("|".join(f"bufgym[_-]{name}" for name in PACKAGES))
    assert not [path for path in sources if names.search(path.read_text(encoding="utf-8"))]


@pytest.mark.parametrize("name", PACKAGES)
def test_a_package_has_the_version_of_the_core_and_what_it_declares(name: str) -> None:
    package = importlib.import_module(f"bufgym_{name}")
    assert package.__version__ == bufgym.__version__ and declared(name)["name"] == f"bufgym-{name}"
    for group, entries in declared(name)["entry-points"].items():
        for entry, place in entries.items():
            what = EntryPoint(entry, place, group).load()
            if group == cli.GROUP:
                for module, _, function in (text.partition(":") for text in functions(what)):
                    assert callable(getattr(importlib.import_module(module), function))
            else:
                assert what[2].items() <= gym.registry[entry].kwargs.items()


def test_a_missing_package_is_named_by_its_command(monkeypatch: Patch, capsys: Capsys) -> None:
    monkeypatch.setattr(cli, "entry_points", lambda group: EntryPoints())
    assert "live" not in shown(["--help"], capsys)
    for words in ("live send", "relay serve --config x.toml", "export afr x.h --to c"):
        fails(words.split(), f"of another package: pip install -e {REPO / 'packages' / 'live'}", capsys)
    fails(["reproduce"], f"pip install -e {REPO / 'packages' / 'papers'}", capsys)
    fails(["nonsense"], 'Unknown command "nonsense"', capsys)


def test_a_package_of_your_own_adds_a_command(monkeypatch: Patch, capsys: Capsys, tmp_path: Path) -> None:
    (tmp_path / "of_mine.py").write_text('HELLO = "of_mine:hello"\n\ndef hello(name: str) -> None:\n    print(name)\n')
    monkeypatch.syspath_prepend(str(tmp_path))
    mine = EntryPoints([EntryPoint("hello", "of_mine:HELLO", cli.GROUP)])
    monkeypatch.setattr(cli, "entry_points", lambda group: mine)
    assert shown(["hello", "you"], capsys) == "you\n"
