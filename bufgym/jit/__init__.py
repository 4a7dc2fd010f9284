"""Compiled functions.

A *kernel* is a plain Python function over arrays that the caller owns. Numba compiles it on its first call and keeps
the machine code on disk; with ``NUMBA_DISABLE_JIT=1`` the same source runs as ordinary Python, and Numba is not even
imported. That is how the tests check the compiled code against its own text, and how a small robot runs a policy.
"""

from bufgym.jit.arrays import (
    JIT,
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

if JIT:
    from bufgym.jit import indexing  # noqa: F401  (teaches Numba)
    from bufgym.jit.announce import compile_silently
    from bufgym.jit.cache import FOLDER, NotCachedError, cached_only
    from bufgym.jit.compile import compile_signature, entry_point_of, kernel, with_address, without_dispatch
else:
    from bufgym.jit.plain import (  # type: ignore[assignment]
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
