"""Compiled functions.

A *kernel* is a plain Python function over arrays that the caller owns. Numba compiles it on its first call and keeps
the machine code on disk; with ``NUMBA_DISABLE_JIT=1`` the same source runs as ordinary Python, and Numba is not even
imported. That is how the tests check the compiled code against its own text, and how a small robot runs a policy.
"""

from bufgym.ground.kernel.arrays import JIT, Floats, Ints, at, item, named, prefetch, records, stretch, table
from bufgym.ground.kernel.interrupt import interruptible

if JIT:
    from bufgym.ground.kernel import indexing  # noqa: F401  (teaches Numba)
    from bufgym.ground.kernel.announce import compile_silently
    from bufgym.ground.kernel.cache import FOLDER, NotKeptError, only_kept
    from bufgym.ground.kernel.compile import compile_for, direct, entry, kernel, located
else:
    from bufgym.ground.kernel.plain import (  # type: ignore[assignment]
        FOLDER,
        NotKeptError,
        compile_for,
        compile_silently,
        direct,
        entry,
        kernel,
        located,
        only_kept,
    )

__all__ = [
    "FOLDER", "JIT", "Floats", "Ints", "NotKeptError", "at", "compile_for", "compile_silently", "direct", "entry",
    "interruptible", "item", "kernel", "located", "named", "only_kept", "prefetch", "records", "stretch", "table",
]  # fmt: skip
