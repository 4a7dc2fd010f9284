"""Every skip names a group of the table, so that ``make test`` can say what brings it."""

import ast
import importlib.util
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from needs import NEEDS, group_of, needs

REPO = Path(__file__).resolve().parent.parent
SKIPS = {"skip", "skipif", "importorskip"}


def unnamed(file: Path) -> list[str]:
    """Lines of skips whose reason ``needs`` does not make."""
    calls = [node for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
    skips = [call for call in calls if isinstance(call.func, ast.Attribute) and call.func.attr in SKIPS]
    by_pytest = [call for call in skips if "pytest" in ast.unparse(call.func)]
    return [f"{file.relative_to(REPO)}:{call.lineno}" for call in by_pytest if "needs(" not in ast.unparse(call)]


def test_every_skip_names_its_group() -> None:
    packages = (f"packages/{name}/tests" for name in ("robot", "relay", "papers"))
    folders = "tests", *packages, "agents", "studies", "website"
    files = [REPO / "conftest.py", *(file for folder in folders for file in (REPO / folder).rglob("*.py"))]
    lines = [line for file in files for line in unnamed(file)]
    assert lines == [], "each needs reason=needs(group, why), with a group of tests/needs.py"


@pytest.mark.parametrize("group", NEEDS)
def test_each_group_has_one_way_to_come(group: str) -> None:
    need = NEEDS[group]
    assert sum(map(bool, (need.apt, need.pip, need.npm, need.by_hand))) == 1 and need.command
    assert group_of(f"Skipped: {needs(group, 'no such thing')}") == group


def tool() -> ModuleType:
    """The program of ``.ci``."""
    file = REPO / ".ci" / "missing.py"
    if not file.exists():
        pytest.skip(needs("git"))
    spec = importlib.util.spec_from_file_location("missing", file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def written(folder: Path, **skipped: str) -> Path:
    file = folder / "skipped.json"
    file.write_text(json.dumps(skipped))
    return file


def test_a_line_for_each_group_says_how_many_and_what_brings_it(tmp_path: Path) -> None:
    skipped = {"a": needs("nats"), "b": needs("browser", "no chromium"), "c": needs("nats"), "d": needs("compiled")}
    lines = tool().message(written(tmp_path, **skipped)).splitlines()[2:]
    assert [line.split()[0] for line in lines] == ["2", "1"]
    assert lines[0].endswith(" apt-get install nats-server") and "pages in a browser" in lines[1]


def test_a_skip_that_the_machine_could_run_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """NATS was installed and is skipped all the same; a browser could not be installed."""
    file, installed = written(tmp_path, a=needs("nats"), b=needs("browser")), tmp_path / "installed.json"
    for here, code in ((["nats"], 1), ([], 0)):
        installed.write_text(json.dumps(here))
        assert tool().main("left", str(file), str(installed)) == code
    assert "a is still skipped: needs nats" in capsys.readouterr().out


def test_what_is_installed_is_what_was_skipped(tmp_path: Path, monkeypatch: Any) -> None:
    """As root on Debian; TypeScript is for `make check`, and comes where npm is."""
    missing, ran = tool(), list[tuple[str, ...]]()
    monkeypatch.setattr(missing, "run", lambda *command: ran.append(command) is None and "chromium" not in command)
    monkeypatch.setattr(missing.shutil, "which", lambda name: name if name == "apt-get" else None)
    monkeypatch.setattr(missing.os, "geteuid", lambda: 0)
    file, installed = written(tmp_path, a=needs("nats"), b=needs("browser"), c=needs("torchrl")), tmp_path / "installed"
    assert missing.main("install", str(file), str(installed)) == 0
    assert [command[-1] for command in ran] == ["-qq", "torchrl==0.14.1", "chromium", "nats-server"]
    assert json.loads(installed.read_text()) == ["torchrl", "nats"]
