"""Kernels where compilation is off: each is its Python function, and Numba is not imported."""

import contextlib
from typing import Any

FOLDER = ""
"""No code is kept."""
only_kept = contextlib.nullcontext


class NotKeptError(Exception):
    """Never raised here."""


def kernel(function: Any) -> Any:
    """``function`` itself."""
    return function


def compile_for(signature: Any, function: Any) -> Any:
    """``function`` itself, whatever its types."""
    return function


def compile_silently() -> None:
    """Do nothing: nothing is compiled."""


direct = entry = kernel
located = compile_for
