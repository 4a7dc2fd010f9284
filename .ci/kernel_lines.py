"""Which lines of kernels ran as plain Python? ``kernel_lines.py DATA`` reads what coverage.py measured in a test run.

A kernel's line counts where the function is compiled: decorated with ``@kernel`` or ``@built_in(...)``, or an argument
of ``kernel`` or ``compile_signature``. Fails where under 95 % ran, where ``kernel_lines.toml`` has no reason for a
kernel some of whose lines did not run, or where a reason there is out of date.
"""

from __future__ import annotations

import ast
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import coverage

REPO = Path(__file__).resolve().parent.parent
FOLDERS = ("model", "sim", "policies", "oracle", "envs")
"""Subpackages of the core. All kernels that decide what a sender does are in these."""
LEAST = 0.95
"""Share of lines that must run."""
DECORATORS = {"kernel", "built_in"}
CALLS = {"kernel", "compile_signature"}
HOOKS = {"on_arrival", "on_departure", "on_dequeue", "on_send", "function"}


def _called(node: ast.expr) -> str:
    """Name of a decorator or of a function that is called."""
    node = node.func if isinstance(node, ast.Call) else node
    return node.id if isinstance(node, ast.Name) else ""


def _compiles(call: ast.Call) -> bool:
    """Whether a call says ``compile=True``."""
    return _called(call) != "" and any(
        word.arg == "compile" and isinstance(word.value, ast.Constant) and word.value.value is True
        for word in call.keywords
    )


def kernels(source: str) -> Iterator[ast.FunctionDef]:
    """All functions of a module that become C."""
    nodes = list(ast.walk(ast.parse(source)))
    compiled: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Call) and (_called(node) in CALLS or _compiles(node)):
            values = [*node.args, *(word.value for word in node.keywords if word.arg in HOOKS)]
            compiled |= {value.id for value in values if isinstance(value, ast.Name)}
    for node in nodes:
        if isinstance(node, ast.FunctionDef):
            marks = node.decorator_list
            decorated = any(
                _called(mark) in DECORATORS or (isinstance(mark, ast.Call) and _compiles(mark)) for mark in marks
            )
            if decorated or node.name in compiled:
                yield node


def lines(function: ast.FunctionDef) -> range:
    """Line numbers of a function's body."""
    return range(function.body[0].lineno, (function.end_lineno or 0) + 1)


def main(data: str) -> int:
    """Print the share and the lines that did not run; 1 for a failure."""
    measured = coverage.Coverage(data_file=data)
    measured.load()
    with open(REPO / ".ci" / "kernel_lines.toml", "rb") as file:
        reasons: dict[str, dict[str, str]] = tomllib.load(file)
    total, ran, faults = 0, 0, []
    for path in sorted(path for folder in FOLDERS for path in (REPO / "bufgym" / folder).rglob("*.py")):
        name = path.relative_to(REPO / "bufgym").as_posix()
        text = path.read_text(encoding="utf-8")
        named = {line: function.name for function in kernels(text) for line in lines(function)}
        found = set(named)
        if not found:
            continue
        _, statements, _, missing, _ = measured.analysis2(str(path))
        total += len(found & set(statements))
        ran += len(found & set(statements) - set(missing))
        given = dict(reasons.pop(name, {}))
        left = set()
        for number in sorted(found & set(missing)):
            if named[number] in given:
                left.add(named[number])
            else:
                line = text.splitlines()[number - 1].strip()
                faults.append(f"bufgym/{name}:{number}: did not run, in {named[number]}: {line}")
        faults += [
            f"kernel_lines.toml: {name}: {kernel}: all of it runs, or it is gone"
            for kernel in given
            if kernel not in left
        ]
    faults += [f"kernel_lines.toml: {name}: has no kernels" for name in reasons]
    share = ran / max(total, 1)
    print("\n".join([f"{ran} of {total} lines of kernels ran as plain Python: {share:.1%}", *faults]))
    if share < LEAST:
        print(f"at least {LEAST:.0%} must")
    return 1 if faults or share < LEAST else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
