"""The hint that names what to install works from a checkout and beside an installed bufgym."""

from __future__ import annotations

import importlib.metadata
import re
import tomllib
from pathlib import Path

import pytest

from bufgym import errors

PYPROJECT = Path(__file__).resolve().parent.parent / "pyproject.toml"
REQUIRES = ["numpy>=2.1", 'matplotlib; extra == "plot"', 'mcap<2,>=1.2; extra == "ros"']
REQUIRES += ['flatbuffers; extra == "robofleet"', 'bufgym[ros]; extra == "robofleet"']


def test_a_hint_names_the_packages_of_an_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: REQUIRES)
    assert errors.install("plot") == "pip install matplotlib"
    # What a shell would take for a redirection is quoted, and an extra of bufgym's own is written out.
    assert errors.install("robofleet") == 'pip install flatbuffers "mcap<2,>=1.2"'


def test_a_source_tree_that_was_never_installed_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: importlib.metadata.distribution("no-such-name"))
    assert errors.install("plot") == 'pip install -e ".[plot]"'


def test_every_hint_names_an_extra_that_there_is() -> None:
    extras = tomllib.loads(PYPROJECT.read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    named = set()
    for path in sorted((PYPROJECT.parent / "bufgym").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        named |= set(re.findall(r"""install\(['"](\w+)['"]\)""", text))
        # No package index knows bufgym: a hint that names it would not work.
        assert not re.search(r"""pip install ["']?bufgym""", text), path
    assert {"plot", "train", "fleet", "ros"} <= named <= set(extras)
