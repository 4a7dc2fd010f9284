"""The C compiler: which one is taken, what it makes, and what is said where it fails."""

import ctypes
import math
import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from needs import needs

from bufgym.kernels import compiler
from bufgym.kernels.compiler import Compiler
from bufgym.utils.errors import BufgymError

SOURCES = {
    "square.c": "double square(double x) { return x * x; }\n",
    "power.c": "#include <math.h>\ndouble power(double x) { return pow(x, 2.0); }\n",
    "apart.c": "double apart(double a, double b, double c) { return a * b + c; }\n",
    "round.c": "#include <stdint.h>\nint64_t round_about(int64_t a) { return a + 1; }\n",
}


@pytest.fixture(autouse=True)
def afresh(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Each test looks for compilers anew, without the settings of who runs it."""
    for name in ("CC", "BUFGYM_CFLAGS"):
        monkeypatch.delenv(name, raising=False)
    searches = compiler.find, compiler.on_path, compiler.zig
    for search in searches:
        search.cache_clear()
    yield
    for search in searches:
        search.cache_clear()


@pytest.fixture
def found() -> Compiler:
    """The compiler of this machine."""
    here = compiler.find()
    if here is None:
        pytest.skip(needs("compiler"))
    return here


def files(folder: Path, **texts: str) -> list[Path]:
    """Files of C in the folder: those above, or those given."""
    for name, text in ({f"{key}.c": text for key, text in texts.items()} or SOURCES).items():
        (folder / name).write_text(text, encoding="utf-8")
    return sorted(folder.glob("*.c"))


def program(folder: Path, name: str, lines: str) -> Path:
    """A program of the shell."""
    path = folder / name
    path.write_text(f"#!/bin/sh\n{lines}\n", encoding="utf-8")
    path.chmod(0o755)
    return path


def test_files_become_one_library(found: Compiler, tmp_path: Path) -> None:
    library = tmp_path / f"kernels{compiler.library_suffix()}"
    found.compile(files(tmp_path), library)
    loaded = ctypes.CDLL(str(library))
    for name in ("square", "power", "apart"):
        getattr(loaded, name).restype = ctypes.c_double
    assert loaded.square(ctypes.c_double(3.0)) == 9.0
    # 0.1 * 10 is 1 + 5.55e-17 before it is rounded, and 1 after: a fused multiply-add would leave the rest.
    assert loaded.apart(*map(ctypes.c_double, (0.1, 10.0, -1.0))) == 0.0
    assert loaded.power(ctypes.c_double(1.1)) == math.pow(1.1, 2.0)
    loaded.round_about.restype, loaded.round_about.argtypes = ctypes.c_int64, [ctypes.c_int64]
    assert loaded.round_about(2**63 - 1) == -(2**63), "whole numbers wrap, as in numpy"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*SOURCES, library.name]), "nothing else is left"


def test_the_same_files_make_the_same_library(found: Compiler, tmp_path: Path) -> None:
    sources = files(tmp_path)
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        found.compile(sources, tmp_path / name / "kernels.so")
    assert (tmp_path / "a/kernels.so").read_bytes() == (tmp_path / "b/kernels.so").read_bytes()


def test_an_error_is_one_line_and_leaves_the_old_library(found: Compiler, tmp_path: Path) -> None:
    library = tmp_path / "kernels.so"
    library.write_bytes(b"old")
    with pytest.raises(BufgymError, match=r"^broken\.c: .* failed: .*broken\.c:2:.*error: .*nobody"):
        found.compile(files(tmp_path, broken="int f(void) {\nreturn nobody;\n}\n", good="int g;\n"), library)
    assert library.read_bytes() == b"old"


def test_flags_reach_every_call_and_the_identity(
    found: Compiler, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = files(tmp_path, answer="int answer(void) { return ANSWER; }\n")
    found.compile(sources, tmp_path / "a.so", flags=["-DANSWER=41"])
    assert ctypes.CDLL(str(tmp_path / "a.so")).answer() == 41
    before = found.identity
    monkeypatch.setenv("BUFGYM_CFLAGS", "-DANSWER='40 + 2'")
    found.compile(sources, tmp_path / "b.so")
    assert ctypes.CDLL(str(tmp_path / "b.so")).answer() == 42
    assert found.identity != before
    monkeypatch.setenv("BUFGYM_CFLAGS", "'")
    with pytest.raises(BufgymError, match=r"^BUFGYM_CFLAGS: \"?'\"?: No closing quotation$"):
        found.compile(sources, tmp_path / "c.so")


def test_no_flag_may_change_a_result(found: Compiler) -> None:
    assert {"-ffp-contract=off", "-fwrapv", "-fno-builtin-pow"} <= set(found.identity.split())
    assert not {"-ffast-math", "-Ofast", "-march=native", "-mcpu=native"} & set(found.identity.split())


def test_cc_is_taken_first_with_its_arguments(found: Compiler, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", f"{found.command[0]} {' '.join(found.command[1:])} -DGIVEN=7")
    compiler.find.cache_clear()
    chosen = compiler.find()
    assert chosen is not None and chosen.command == [*found.command, "-DGIVEN=7"]
    chosen.compile(files(tmp_path, given="int given(void) { return GIVEN; }\n"), tmp_path / "a.so")
    assert ctypes.CDLL(str(tmp_path / "a.so")).given() == 7


@pytest.mark.skipif(sys.platform == "win32", reason=needs("system"))
def test_a_cc_that_does_not_work_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    broken = program(tmp_path, "broken", "echo 'ld: error: no such luck' >&2\nexit 1")
    for value, why in {
        "nonesuch -O": "'nonesuch -O': must be a C compiler: no such program",
        str(broken): "must be a C compiler: ld: error: no such luck",
        "'": "must be a C compiler: No closing quotation",
    }.items():
        monkeypatch.setenv("CC", value)
        with pytest.raises(BufgymError, match=r"^CC: ") as error:
            compiler.find()
        assert str(error.value).endswith(why)


@pytest.mark.skipif(sys.platform == "win32", reason=needs("system"))
def test_the_first_that_works_is_taken_and_else_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program(tmp_path, "cc", "exit 1")
    # Like Debian's gcc without libc6-dev: it says what it is, and finds no header.
    program(tmp_path, "gcc", 'case "$1" in -E) exit 1 ;; esac\necho gcc 1')
    monkeypatch.setattr(compiler.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert compiler.find() is None
    program(tmp_path, "clang", "echo clang 2")
    for search in (compiler.find, compiler.on_path):
        search.cache_clear()
    taken = compiler.find()
    assert taken is not None and taken.command == [str(tmp_path / "clang")] and taken.version == "clang 2"
    assert compiler.find() is taken, "it is looked for once"


def test_only_zig_compiles_for_other_platforms(tmp_path: Path) -> None:
    gcc = Compiler(["gcc"], "gcc 1", "x86_64-linux-gnu")
    with pytest.raises(BufgymError, match=r"^BUFGYM_TARGET: aarch64-linux: only zig compiles for other platforms$"):
        gcc.compile(files(tmp_path), tmp_path / "a.so", target="aarch64-linux")
    with pytest.raises(BufgymError, match=r"^BUFGYM_TARGET: unknown target 'amiga'; known: x86_64-linux, "):
        compiler.library_suffix("amiga")


@pytest.mark.nightly
@pytest.mark.parametrize("target", [name for name in compiler.TARGETS if name != "windows-x86_64"])
def test_zig_compiles_for_every_target(target: str, tmp_path: Path) -> None:
    """Windows is left out: zig then compiles its C library first, for a minute."""
    zig = compiler.zig()
    if zig is None:
        pytest.skip(needs("zig"))
    library = tmp_path / f"kernels{compiler.library_suffix(target)}"
    zig.compile(files(tmp_path), library, target=target)
    assert library.read_bytes()[:4] in (b"\x7fELF", b"\xcf\xfa\xed\xfe")


@pytest.mark.nightly
def test_zig_needs_no_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    zig = compiler.zig()
    if zig is None:
        pytest.skip(needs("zig"))
    monkeypatch.setattr(compiler, "_caches", lambda: False)
    monkeypatch.setenv("HOME", str(tmp_path / "none"))
    zig.compile(files(tmp_path), tmp_path / "kernels.so")
    assert not (tmp_path / "none").exists()


@pytest.mark.nightly
def test_kernels_for_arm_compute_the_same(tmp_path: Path) -> None:
    """Built by zig for aarch64, and run by qemu."""
    zig, qemu = compiler.zig(), shutil.which("qemu-aarch64") or shutil.which("qemu-aarch64-static")
    if zig is None:
        pytest.skip(needs("zig"))
    if qemu is None:
        pytest.skip(needs("qemu"))
    sums = "volatile double a = 0.1, b = 10, c = -1;"
    text = f'#include <stdio.h>\nint main(void) {{ {sums} printf("%a", a * b + c); }}\n'
    (main,) = files(tmp_path, main=text)
    arguments = [*zig._flags(None), "-target", "aarch64-linux-musl", "-static"]
    compiler._output([*zig.command, *arguments, str(main), "-o", str(tmp_path / "main"), "-lm"], tmp_path)
    assert compiler._output([os.fspath(qemu), str(tmp_path / "main")], tmp_path) == "0x0p+0"
