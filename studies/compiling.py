"""What compilation costs in each way: its lines, the first step of a batch without and with kept code, staleness.

``python -m studies.compiling [--compiler plain] [--repeats N]``

The ways are the pipeline in Numba's compiler and plain Numba (``BUFGYM_COMPILER``). A process makes each figure. Its
time is the processor's, from the start of Python to the first step of 64 rows of ``Uplink-v0``. Python's bytecode is
kept in a folder of this command, as installed packages keep theirs. With ``PYTHONDONTWRITEBYTECODE=1`` and no bytecode
beside the packages, every process translates 800 modules anew. That takes another second.

At last a copy of the package is edited, several calls below the kernel that Python calls. The copy finds the machine
code of the original and must not run it. Its observations must equal those of the same text as plain Python.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from bufgym.cli.options import Count
from bufgym.jit.way import PIPELINE, PLAIN, VARIABLE
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import PACKAGE
from bufgym.utils.tables import Table
from studies.page import command

ROWS = 64
PROGRAM = f"""
import time
import gymnasium, numpy
import bufgym
batch = gymnasium.make_vec(
    "bufgym/Uplink-v0", {ROWS}, vectorization_mode="vector_entry_point", capacity=8, observation="flat"
)
_, info = batch.reset(seed=1)
observation, *_, info = batch.step(info["action_mask"].argmax(axis=1))
first_s = time.process_time()
total = observation.sum(dtype=float)
for _ in range(40):
    observation, *_, info = batch.step(info["action_mask"].argmax(axis=1))
    total += observation.sum(dtype=float)
best_s, evict = float("inf"), numpy.zeros({ROWS}, int)
for _ in range({{repeats}}):
    began_s = time.process_time()
    for _ in range(100):
        batch.step(evict)
    best_s = min(best_s, time.process_time() - began_s)
print(first_s, best_s / 100 / {ROWS} * 1e9, total)
"""
"""Prints the time of the first step in s, ns a step of one row, and the sum of 41 observations of all rows."""

EDITED, TEXT, EDIT = Path("model", "qoi.py"), "1.0 - math.exp(d * v[1])", "0.5 * (1.0 - math.exp(d * v[1]))"
"""A file, the text in it that V is computed by, and another that halves V. A step reaches it by several calls."""


MODULES = {PIPELINE: ("pipeline", "templates", "compile", "cache"), PLAIN: ("njit",)}
"""Way to compile -> the modules of ``bufgym/jit`` that it alone has."""
ROWS_OF_TABLE = (
    "lines of its own in bufgym/jit",
    f"first step of {ROWS} rows, nothing kept",
    f"first step of {ROWS} rows, code kept",
    "a step of one of these rows",
    "sum of observations before the edit",
    "the same after it, compiled",
    "the same after it, as plain Python",
    "stale code was run",
)


def run(
    package: Path, folder: Path, repeats: int, code: str = "code", **environment: str
) -> tuple[float, float, float]:
    """The three numbers of ``PROGRAM`` in a new process with this package; ``folder`` keeps code and bytecode."""
    settings: Mapping[str, str] = {
        **{name: text for name, text in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"},
        "PYTHONPATH": str(package.parent),
        "PYTHONPYCACHEPREFIX": str(folder / "bytecode"),
        "NUMBA_CACHE_DIR": str(folder / code),
        **environment,
    }
    program = [sys.executable, "-c", PROGRAM.format(repeats=repeats)]
    done = subprocess.run(program, env=settings, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise BufgymError(f"a new process failed: {done.stderr.strip().splitlines()[-1]}")
    first_s, step_ns, total = map(float, done.stdout.split())
    return first_s, step_ns, total


def edited(folder: Path) -> Path:
    """A copy of the package in ``folder``, with the shipped traces beside it, whose V is half as large."""
    copy = folder / PACKAGE.name
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(PACKAGE.parent / "traces", folder / "traces")
    text = (copy / EDITED).read_text(encoding="utf-8")
    if text.count(TEXT) != 1:
        raise BufgymError(f"{EDITED}: must hold {TEXT!r} once")
    (copy / EDITED).write_text(text.replace(TEXT, EDIT), encoding="utf-8")
    return copy


def lines(compiler: str) -> int:
    """Lines that this way alone has."""
    files = (PACKAGE / "jit" / f"{name}.py" for name in MODULES[compiler])
    return sum(len(file.read_text(encoding="utf-8").splitlines()) for file in files)


def measured(compiler: str, repeats: int) -> list[str]:
    """What one way costs, a text for each of ``ROWS_OF_TABLE``."""
    with tempfile.TemporaryDirectory() as name:
        folder, way = Path(name), {VARIABLE: compiler}
        run(PACKAGE, folder, 0, **way)  # writes bytecode
        cold = min(run(PACKAGE, folder, 0, f"cold{k}", **way)[0] for k in range(repeats))
        warm = [run(PACKAGE, folder, 20, **way) for _ in range(repeats)]
        copy = edited(folder)
        compiled, uncompiled = run(copy, folder, 0, **way)[2], run(copy, folder, 0, NUMBA_DISABLE_JIT="1")[2]
    return [
        str(lines(compiler)),
        f"{cold:.2f} s",
        f"{min(first_s for first_s, _, _ in warm):.2f} s",
        f"{min(step_ns for _, step_ns, _ in warm):.0f} ns",
        f"{warm[0][2]:.6f}",
        f"{compiled:.6f}",
        f"{uncompiled:.6f}",
        "no" if compiled == uncompiled != warm[0][2] else "YES",
    ]


def main(*, compiler: Literal["pipeline", "plain"] | None = None, repeats: Count = 3) -> None:
    """Measure what compilation costs on this machine, and whether an edit ever runs stale code.

    Args:
        compiler: Measure this way alone.
        repeats: Best of so many.
    """
    chosen = [compiler] if compiler else list(MODULES)
    columns = [measured(one, repeats) for one in chosen]
    rows = [[what, *texts] for what, *texts in zip(ROWS_OF_TABLE, *columns, strict=True)]
    print(Table(["", *chosen], [("", rows)]).plain())


if __name__ == "__main__":
    command(main)
