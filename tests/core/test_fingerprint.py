"""Machine code rests on what a kernel calls and reads, and on nothing else."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from needs import needs

from bufgym.jit import JIT
from bufgym.jit.code import name_of
from bufgym.jit.fingerprint import fingerprint
from bufgym.jit.values import kind_of

REPO = Path(__file__).resolve().parents[2]

TALE = """
from typing import NamedTuple
import math
import numpy as np
from bufgym.jit import kernel

READ, UNREAD, TABLE = 2, 3, np.array([1.0, 2.0])
RECORDS = np.zeros(1, [("near", np.int64), ("far", np.int64)])

class Pair(NamedTuple):
    a: int
    b: int = 1

def shifted_by(step):
    @kernel
    def shifted(k):
        return k + step
    return shifted

shift = shifted_by(5)

def helper(k):
    return k * 3

@kernel
def innermost(k):
    return k * READ + math.floor(0.5)

@kernel
def inner(k, factor=7):
    "Says what it does."
    return innermost(k) + shift(k) + int(TABLE[1]) * factor + RECORDS["near"][0] + helper(k)

@kernel
def outer(k):
    pair = Pair(inner(k), k)
    return pair.a + pair.b

@kernel
def bystander(k):
    return k
"""


def hash_of(source: str) -> str:
    """The fingerprint of ``outer`` in a module with this source."""
    module = ModuleType("tale")
    exec(compile(source, "tale.py", "exec"), module.__dict__)
    return fingerprint(getattr(module.outer, "py_func", module.outer))


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("import math", "# a comment\n\nimport math"),
        ("UNREAD, TABLE = 2, 3,", "UNREAD, TABLE = 2, 4,"),
        ("    return k\n", "    return k + 1\n"),
    ],
    ids=["comment and lines", "constant that nobody reads", "kernel that nobody calls"],
)
def test_what_code_does_not_rest_on(before: str, after: str) -> None:
    assert TALE.count(before) == 1
    assert hash_of(TALE.replace(before, after)) == hash_of(TALE)


needs_compilation = pytest.mark.skipif(not JIT, reason=needs("compiled", "nothing is cached without compilation"))


@needs_compilation
@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("return pair.a + pair.b", "return pair.a - pair.b"),
        ("return innermost(k) + shift(k)", "return innermost(k) - shift(k)"),
        ("return k * READ", "return k + READ"),
        ("READ, UNREAD, TABLE = 2,", "READ, UNREAD, TABLE = 4,"),
        ("np.array([1.0, 2.0])", "np.array([1.0, 3.0])"),
        ("factor=7", "factor=8"),
        ("shifted_by(5)", "shifted_by(6)"),
        ("math.floor", "math.ceil"),
        ('RECORDS["near"]', 'RECORDS["far"]'),
        ("return k * 3", "return k + 3"),
        ("    a: int\n    b: int = 1", "    b: int\n    a: int = 1"),
        ("    b: int = 1", "    b: int = 2"),
    ],
    ids=lambda text: text.strip().partition("\n")[0][:30],
)
def test_what_code_rests_on(before: str, after: str) -> None:
    assert TALE.count(before) == 1
    assert hash_of(TALE.replace(before, after)) != hash_of(TALE)


def test_kinds_are_told_by_the_names_of_their_fields() -> None:
    """Code finds a field by its place: two tuples that differ in their names alone are different kinds."""
    tuples = [ModuleType(str(k)) for k in range(2)]
    renamed = TALE.replace("a: int\n    b: int = 1", "b: int\n    a: int = 1")
    for module, source in zip(tuples, (TALE, renamed), strict=True):
        exec(source, module.__dict__)
    one, other = (name_of(square, (kind_of(module.Pair(1, 2)),)) for module in tuples)
    assert one != other


def square(pair: Any) -> Any:
    """A function with a name."""
    return pair.a


def compiled(folder: Path, script: str) -> list[str]:
    """Names of the kernels that a process compiles which runs ``script`` with the packages in ``folder``."""
    listen = """
from bufgym.jit import code
made = code._compiled
def compiled(function, *rest):
    print("compiles", function.__name__)
    return made(function, *rest)
code._compiled = compiled
"""
    command = [sys.executable, "-c", listen + script]
    environment = {**os.environ, "PYTHONPATH": str(folder), "BUFGYM_CACHE": str(folder / "code")}
    done = subprocess.run(command, env=environment, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [line.split()[1] for line in done.stdout.splitlines() if line.startswith("compiles ")]


@needs_compilation
def test_a_change_recompiles_what_calls_it_and_nothing_else(tmp_path: Path) -> None:
    """A command has no kernels. AFR's text does not matter to Drop Oldest, and both are asked for here."""
    shutil.copytree(REPO / "bufgym", tmp_path / "bufgym", ignore=shutil.ignore_patterns("__pycache__", "built"))
    script = "from bufgym import policies\nfor name in ('afr', 'drop-oldest'): policies.get(name).compiled"
    cold = compiled(tmp_path, script)
    assert {"afr", "drop_oldest"} <= set(cold)
    assert compiled(tmp_path, script) == []

    command = tmp_path / "bufgym" / "cli" / "bench.py"
    command.write_text(command.read_text() + "\nADDED = 1\n")
    assert compiled(tmp_path, script) == []

    afr = tmp_path / "bufgym" / "policies" / "afr.py"
    text = afr.read_text()
    assert "return REJECT" in text
    afr.write_text(text.replace("return REJECT", "return REJECT - 0 * len(buffer.slots)"))
    again = compiled(tmp_path, script)
    assert "afr" in again and "drop_oldest" not in again


LEAF = """
from typing import NamedTuple
import numpy as np
from bufgym.jit import kernel, records

FACTOR = 2
CELL = np.dtype([("near", np.int64), ("far", np.int64)])

class Pair(NamedTuple):
    first: int
    second: int

@kernel
def leaf(cells):
    return cells[0].near * FACTOR
"""
BRANCH = """
from leaf import kernel, leaf

@kernel
def branch(cells, pair):
    return leaf(cells) + pair.first
"""
ROOT = """
from branch import branch, kernel
from leaf import CELL, Pair, records

@kernel
def root(cells, pair):
    return branch(cells, pair)

cells = records(1, CELL)
cells.view("i8")[:] = 10, 20
print(root(cells, Pair(1, 3)))
"""


NIGHTLY = [
    ("FACTOR = 2", "FACTOR = 4", 10 * 4 + 1),
    ('("near", np.int64), ("far", np.int64)', '("far", np.int64), ("near", np.int64)', 20 * 2 + 1),
    ('("near", np.int64)', '("near", np.int32), ("gap", np.int32)', 10 * 2 + 1),
    ("first: int\n    second: int", "second: int\n    first: int", 10 * 2 + 3),
]
"""Edits of a constant, of the order and the width of a dtype's fields, and of the order of a tuple's fields."""


@needs_compilation
@pytest.mark.parametrize(
    ("before", "after", "result"),
    [
        ("cells[0].near * FACTOR", "cells[0].near - FACTOR", 10 - 2 + 1),
        *(pytest.param(*edit, marks=pytest.mark.nightly) for edit in NIGHTLY),
    ],
    ids=["callee two levels down", "constant", "fields of a dtype", "width of a field", "fields of a tuple"],
)
def test_a_new_process_never_runs_code_of_an_edited_source(
    before: str, after: str, result: int, tmp_path: Path
) -> None:
    """The edited file is not the one of the kernel that Python calls, whose code alone is kept."""
    environment = {**os.environ, "PYTHONPATH": str(REPO), "BUFGYM_CACHE": str(tmp_path / "code")}

    def printed(leaf: str) -> int:
        for name, text in (("leaf", leaf), ("branch", BRANCH), ("root", ROOT)):
            (tmp_path / f"{name}.py").write_text(text)
        command = [sys.executable, "-B", str(tmp_path / "root.py")]
        return int(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)

    assert LEAF.count(before) == 1
    assert [printed(LEAF), printed(LEAF.replace(before, after)), printed(LEAF)] == [21, result, 21]
    assert len(list((tmp_path / "code").rglob("*root*.sum"))) == 2, "the third run found the first one's code"


def test_every_kernel_has_a_closure_that_any_process_finds_again() -> None:
    """No constant that a kernel reads is told by its address."""
    from bufgym.jit import fingerprint as module

    seen: list[str] = []

    def described(value: Any, waiting: list[Any]) -> str:
        seen.append(answer := original(value, waiting))
        return answer

    original, module._described = module._described, described
    try:
        from bufgym.envs import step
        from bufgym.sim import rollout

        for one in (step.step_rows, step.step_cells, rollout.rollout):
            fingerprint(getattr(one, "py_func", one))
    finally:
        module._described = original
    assert [text for text in seen if " at 0x" in text] == []
