"""Kernels where compilation is off: each is its Python function, and Numba is not imported."""

import contextlib
from typing import Any

FOLDER = ""
"""No code is cached."""
cached_only = contextlib.nullcontext


class NotCachedError(Exception):
    """Never raised here."""


def kernel(function: Any) -> Any:
    """``function`` itself."""
    return function


def compile_signature(signature: Any, function: Any) -> Any:
    """``function`` itself, whatever its types."""
    return function


def compile_silently() -> None:
    """Do nothing: nothing is compiled."""


without_dispatch = entry_point_of = kernel
with_address = compile_signature
