"""Compiled functions.

A *kernel* is a plain Python function over arrays that the caller owns. Numba compiles it on its first call and keeps
the machine code on disk; with ``NUMBA_DISABLE_JIT=1`` the same source runs as ordinary Python, and Numba is not even
imported. That is how the tests check the compiled code against its own text, and how a small robot runs a policy.

Numba compiles by our own ``pipeline``, or, in versions that it does not know, by ``njit`` alone (see ``way``).
"""

from bufgym.jit.arrays import (
    Floats,
    Ints,
    named,
    prefetch,
    records,
    unchecked_at,
    unchecked_item,
    unchecked_slice,
    unchecked_table,
)
from bufgym.jit.interrupt import interruptible
from bufgym.jit.way import COMPILER, JIT, PIPELINE

if JIT:
    from bufgym.jit import indexing  # noqa: F401  (teaches Numba)
    from bufgym.jit.announce import compile_silently
    from bufgym.jit.calls import entry_point_of, with_address, without_dispatch
    from bufgym.jit.folder import FOLDER, NotCachedError, cached_only

    if COMPILER == PIPELINE:
        from bufgym.jit.compile import compile_signature, kernel
    else:
        from bufgym.jit.njit import compile_signature, kernel
else:
    from bufgym.jit.uncompiled import (  # type: ignore[assignment]
        FOLDER,
        NotCachedError,
        cached_only,
        compile_signature,
        compile_silently,
        entry_point_of,
        kernel,
        with_address,
        without_dispatch,
    )

__all__ = [
    "FOLDER",
    "JIT",
    "Floats",
    "Ints",
    "NotCachedError",
    "cached_only",
    "compile_signature",
    "compile_silently",
    "entry_point_of",
    "interruptible",
    "kernel",
    "named",
    "prefetch",
    "records",
    "unchecked_at",
    "unchecked_item",
    "unchecked_slice",
    "unchecked_table",
    "with_address",
    "without_dispatch",
]  # fmt: skip
