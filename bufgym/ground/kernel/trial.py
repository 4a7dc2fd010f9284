"""Whether Numba's private parts are as ``compile`` needs them."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np

from bufgym.ground.kernel.arrays import JIT, at, item, stretch
from bufgym.ground.processes import COMPILES, compiling

TRIED = (0, 68)
"""The newest Numba for which all tests passed: a later one is tried first, in a process of its own, once."""
NOTICE = "bufgym: this Numba's private parts differ ({}): compiling takes longer, in each process; results are equal"


def works() -> bool:
    """Whether kernels are compiled by ``compile``; if not, a line on stderr says why."""
    if not JIT:
        return False
    try:
        from bufgym.ground.kernel.cache import FOLDER
        from bufgym.ground.kernel.compile import kernel  # noqa: F401
    except (ImportError, AttributeError, TypeError) as error:
        return _say(str(error))
    version = str(numba.__version__)
    if tuple(map(int, version.split(".")[:2])) <= TRIED or COMPILES in os.environ or getattr(sys, "frozen", False):
        return True
    passed = Path(FOLDER, f"numba-{version}.works")
    if passed.exists():
        return True
    if compiling(__name__, "attempt", quiet=True):
        return _say(f"a kernel failed with Numba {version}")
    passed.touch()
    return True


def _say(why: str) -> bool:
    print(NOTICE.format(why), file=sys.stderr)
    return False


class _Given(NamedTuple):
    rows: Any
    several: Any


def attempt() -> None:
    """Compile a kernel that needs every private part, keep it, and load it again."""
    from bufgym.ground.kernel.compile import kernel

    def inner(given: Any, k: int) -> Any:
        return at(given.rows, 1, k) + (0.0 if given.several is None else given.several.missing)

    def outer(given: Any) -> Any:
        again = _Given(given.rows, None)
        return inner_kernel(again, 1) + item(stretch(given.rows, 0, 1, 2), 1)

    inner_kernel, given = kernel(inner), _Given(np.arange(6.0).reshape(2, 3), None)
    for _ in range(2):
        if kernel(outer)(given) != 6.0:
            raise SystemExit("a wrong result")
