"""Kernels by Numba's ``njit`` alone: where compilation is off, or Numba's private parts are not as ``compile`` needs.

Results are equal bit for bit. Compiling takes longer, and again in each process, as no code is kept.
"""

import contextlib
from collections.abc import Callable
from typing import Any, TypeVar, cast

from bufgym.ground.kernel.arrays import JIT

if JIT:
    import numba
    from numba.core import options
    from numba.core.compiler import CompilerBase, DefaultPassBuilder

    from bufgym.ground.kernel.announce import compile_silently as compile_silently
    from bufgym.ground.kernel.none_fields import with_none_fields

    _Compiler: Any = CompilerBase

    class _PlainCompiler(_Compiler):  # type: ignore[misc]
        def define_pipelines(self) -> list[Any]:
            return [with_none_fields(cast(Any, DefaultPassBuilder).define_nopython_pipeline(self.state))]

    _OPTIONS: Any = {"nogil": True, "error_model": "numpy", "pipeline_class": _PlainCompiler}
    if hasattr(options.DefaultOptions, "_nrt"):
        _OPTIONS["_nrt"] = False  # no counting of references: a step is ten times as fast
else:

    def compile_silently() -> None:
        """Do nothing: nothing is compiled."""


Function = TypeVar("Function", bound=Callable[..., Any])

FOLDER = ""
"""No code is kept."""


class NotKeptError(Exception):
    """Never raised here."""


only_kept = contextlib.nullcontext


def kernel(function: Function) -> Function:
    """Compile ``function`` on its first call, for the types of its arguments."""
    return cast(Function, cast(Any, numba).njit(**_OPTIONS)(function) if JIT else function)


def compile_for(signature: Any, function: Function) -> Function:
    """Compile ``function`` now for exactly ``signature``, so that it can be passed to other kernels as a value."""
    return cast(Function, cast(Any, numba).njit(signature, **_OPTIONS)(function) if JIT else function)


def direct(compiled: Function) -> Function:
    """``compiled``: each call looks at the types of its arguments."""
    return compiled


def code_for(called: Any, batch: Any, last: Any) -> Any:
    """``called``, likewise."""
    return called


entry: Callable[[Any], Any] = direct


def located(signature: Any, compiled: Any) -> Any:
    """``compiled``: Numba looks up its address at each call."""
    return compiled


def compile_here() -> None:
    """Nothing: every call compiles in this process."""
