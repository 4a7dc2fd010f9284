"""Compiled functions.

A *kernel* is a plain Python function over arrays that the caller owns. Numba compiles it on its first call and keeps
the machine code on disk; with ``NUMBA_DISABLE_JIT=1`` the same source runs as ordinary Python, and Numba is not even
imported. That is how the tests check the compiled code against its own text, and how a small robot runs a policy.
"""

import sys

from bufgym.ground.kernel.arrays import JIT, Floats, Ints, at, item, named, prefetch, records, stretch, table
from bufgym.ground.kernel.interrupt import interruptible

if JIT:
    from bufgym.ground.kernel import indexing  # noqa: F401  (teaches Numba)

try:
    if not JIT:
        raise ImportError
    from bufgym.ground.kernel.announce import compile_silently
    from bufgym.ground.kernel.cache import FOLDER, NotKeptError, only_kept
    from bufgym.ground.kernel.compile import (
        code_for,
        compile_for,
        compile_here,
        direct,
        entry,
        kernel,
        located,
        try_out,
    )

    try_out()
except Exception as error:  # whatever another Numba may raise
    if JIT:
        why = " ".join(str(error).split())
        print(f"bufgym: this Numba's private parts differ ({why}): slower to compile, equal results", file=sys.stderr)
    from bufgym.ground.kernel.plain import (  # type: ignore[assignment]
        FOLDER,
        NotKeptError,
        code_for,
        compile_for,
        compile_here,
        compile_silently,
        direct,
        entry,
        kernel,
        located,
        only_kept,
    )

__all__ = [
    "FOLDER", "JIT", "Floats", "Ints", "NotKeptError", "at", "code_for", "compile_for", "compile_here",
    "compile_silently", "direct", "entry", "interruptible", "item", "kernel", "located", "named", "only_kept",
    "prefetch", "records", "stretch", "table",
]  # fmt: skip
