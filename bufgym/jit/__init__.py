"""Compiled functions.

A *kernel* is a plain Python function over arrays that the caller owns, in the small language of ``bufgym.kernels``. Its
C comes with the package. What is not there, or has changed since, is compiled at its first call and kept on disk.
Without a compiler it runs as ordinary Python, as all kernels do with ``BUFGYM_KERNELS=python``. That is how the tests
check the compiled code against its own text.
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
from bufgym.jit.call import Hook, Repeated, compile_signature, kernel
from bufgym.jit.interrupt import interruptible
from bufgym.jit.way import JIT

__all__ = [
    "JIT",
    "Floats",
    "Hook",
    "Ints",
    "Repeated",
    "compile_signature",
    "interruptible",
    "kernel",
    "named",
    "prefetch",
    "records",
    "unchecked_at",
    "unchecked_item",
    "unchecked_slice",
    "unchecked_table",
]  # fmt: skip
