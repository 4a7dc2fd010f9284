"""The build hook, on a small project: what the wheel holds, what it is called, and what the build asks for."""

import ctypes
import json
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from needs import needs

from bufgym.kernels import compiler

REPO = Path(__file__).resolve().parents[2]
PROJECT = """
[project]
name = "bufgym"
version = "0"
requires-python = ">=3.11"
[tool.hatch.build.targets.wheel]
packages = ["bufgym"]
exclude = ["/bufgym/kernels/built"]
[tool.hatch.build.targets.wheel.hooks.custom]
path = "hatch_build.py"
"""
TRANSLATOR = '''
import json

def sources(folder):
    """Two kernels."""
    for name in ("one", "two"):
        (folder / f"{name}.c").write_text(f"int {name}(void) {{ return {len(name)}; }}")
    (folder / "entries.json").write_text(json.dumps(["one", "two"]))
    return sorted(folder.glob("*.c"))
'''
BACKEND = "import sys, hatchling.build as backend; print(getattr(backend, sys.argv[1])(*sys.argv[2:]))"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A package with bufgym's compiler and hook, and two kernels."""
    pytest.importorskip("hatchling", reason=needs("extras"))
    folder = tmp_path / "project"
    for path in ("bufgym/kernels/compiler.py", "bufgym/utils/errors.py", "bufgym/utils/files.py", "hatch_build.py"):
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(REPO / path, folder / path)
    for package in ("bufgym", "bufgym/kernels", "bufgym/utils"):
        (folder / package / "__init__.py").touch()
    (folder / "bufgym/build.py").write_text(TRANSLATOR, encoding="utf-8")
    (folder / "pyproject.toml").write_text(PROJECT, encoding="utf-8")
    return folder


@pytest.fixture
def has_compiler() -> None:
    """Skips where nothing compiles C."""
    if compiler.find() is None:
        pytest.skip(needs("compiler"))


def call(project: Path, *words: str, **settings: str) -> subprocess.CompletedProcess[str]:
    """Call a function of the build backend in the project, as pip does; ``settings`` are environment variables."""
    own = {name: value for name, value in os.environ.items() if not name.startswith(("BUFGYM_", "PYTHONPATH"))}
    command = [sys.executable, "-c", BACKEND, *words]
    return subprocess.run(command, cwd=project, env={**own, **settings}, capture_output=True, text=True, check=False)


def wheel(project: Path, **settings: str) -> Path:
    """Build a wheel."""
    done = call(project, "build_wheel", str(project.parent), **settings)
    assert done.returncode == 0, done.stderr
    return project.parent / done.stdout.split()[-1]


def kernels(wheel: Path) -> list[str]:
    """Names of the files of compiled kernels in a wheel."""
    start = "bufgym/kernels/built/"
    with zipfile.ZipFile(wheel) as packed:
        return sorted(name.removeprefix(start) for name in packed.namelist() if name.startswith(start))


@pytest.mark.usefixtures("has_compiler")
def test_a_wheel_holds_the_library_of_this_platform(project: Path) -> None:
    made = wheel(project)
    assert re.fullmatch(r"bufgym-0-py3-none-(?!any)\w+\.whl", made.name)
    library = f"bufgym_kernels{compiler.library_suffix()}"
    assert kernels(made) == [library, "entries.json"]
    with zipfile.ZipFile(made) as packed:
        packed.extractall(project.parent / "unpacked")
    built = project.parent / "unpacked/bufgym/kernels/built"
    assert ctypes.CDLL(str(built / library)).two() == 3
    assert json.loads((built / "entries.json").read_text(encoding="utf-8")) == ["one", "two"]
    assert not (project / "bufgym/kernels/built").exists(), "a wheel leaves the source tree as it is"


@pytest.mark.usefixtures("has_compiler")
def test_an_editable_installation_has_the_library_in_the_source_tree(project: Path) -> None:
    pytest.importorskip("editables", reason=needs("extras"))
    done = call(project, "build_editable", str(project.parent))
    assert done.returncode == 0, done.stderr
    library = project / "bufgym/kernels/built" / f"bufgym_kernels{compiler.library_suffix()}"
    assert ctypes.CDLL(str(library)).one() == 3
    assert kernels(project.parent / done.stdout.split()[-1]) == []
    library.with_name("old.txt").touch()
    assert "old.txt" not in kernels(wheel(project)), "a wheel has its own library, and not what lies in the tree"


def test_what_a_build_asks_for(project: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    asked = ("get_requires_for_build_wheel",)
    assert "ziglang" in call(project, *asked, PATH=str(empty), CC="").stdout, "there is no compiler"
    assert "ziglang" in call(project, *asked, BUFGYM_TARGET="aarch64-linux").stdout, "gcc compiles for one platform"
    assert call(project, *asked, PATH=str(empty), CC="", BUFGYM_NO_KERNELS="1").stdout == "[]\n"
    assert call(project, *asked, PATH=str(empty), CC="mine").stdout == "[]\n", "who names a compiler means it"
    if compiler.on_path():
        assert call(project, *asked).stdout == "[]\n"


def test_without_a_compiler_the_build_says_what_to_install(project: Path, tmp_path: Path) -> None:
    hidden = "import sys; sys.modules['ziglang'] = None"
    with (project / "bufgym/__init__.py").open("a", encoding="utf-8") as file:
        file.write(hidden)
    settings = {"PATH": str(tmp_path / "empty"), "CC": ""}
    done = call(project, "build_wheel", str(tmp_path), **settings)
    assert done.returncode != 0
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: bufgym's kernels are compiled C: install a C compiler (")
    assert "pip install ziglang" in line and line.endswith("; BUFGYM_NO_KERNELS=1 builds without them")
    made = wheel(project, **settings, BUFGYM_NO_KERNELS="1")
    assert made.name == "bufgym-0-py3-none-any.whl" and kernels(made) == []


def test_a_wrong_setting_is_one_line(project: Path) -> None:
    done = call(project, "build_wheel", str(project.parent), CC="nonesuch")
    assert done.stderr == "error: CC: nonesuch: must be a C compiler: no such program\n"


@pytest.mark.nightly
def test_a_wheel_for_another_platform(project: Path) -> None:
    if compiler.zig() is None:
        pytest.skip(needs("zig"))
    made = wheel(project, BUFGYM_TARGET="aarch64-linux")
    assert made.name == "bufgym-0-py3-none-manylinux_2_17_aarch64.whl"
    assert kernels(made) == ["bufgym_kernels.so", "entries.json"]


def test_the_sdist_carries_the_hook() -> None:
    """Else no wheel can be built of it; bufgym's own settings, read as text."""
    settings = (REPO / "pyproject.toml").read_text(encoding="utf-8")
    assert '"/hatch_build.py"' in settings and 'exclude = ["/bufgym/kernels/built"]' in settings
