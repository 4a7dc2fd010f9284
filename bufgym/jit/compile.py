"""The decorator for compiled functions, with the pipeline."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba.core import types
from numba.core.registry import CPUDispatcher

from bufgym.jit import templates  # noqa: F401  (teaches Numba)
from bufgym.jit.cache import Code
from bufgym.jit.pipeline import PART, KernelCompiler

Function = TypeVar("Function", bound=Callable[..., Any])

# Arithmetic follows IEEE 754 to the letter (no fast maths): single = batch and compiled = uncompiled, bit for bit.
# Kernels work on arrays that their caller holds, so reference counting (_nrt) is off and one kernel is inlined into the
# next: together that is five times faster. In return a kernel must neither allocate nor return an array to Python.
# Compiling takes as long as the code is that is inlined: call a large kernel from one place.
_OPTIONS = {"nopython": True, "nogil": True, "error_model": "numpy", "_nrt": False}


class _Part(CPUDispatcher):
    """A kernel as other kernels call it."""

    def get_call_template(self, arguments: Any, named: Any) -> Any:
        """Type a call; one form serves every constant, which LLVM propagates when it inlines the form."""
        unliteral = cast(Any, types).unliteral
        kinds = {name: unliteral(kind) for name, kind in named.items()}
        return cast(Any, super()).get_call_template([unliteral(kind) for kind in arguments], kinds)


class _Kernel(CPUDispatcher):
    """A kernel as Python calls it. Other kernels call a second form, without the entry from Python.

    That entry repeats the whole code, and few kernels need one.
    """

    @functools.cached_property
    def _part(self) -> Any:
        part = cast(Any, _Part)
        return part(cast(Any, self).py_func, targetoptions={**_OPTIONS, **PART}, pipeline_class=KernelCompiler)

    @property
    def _numba_type_(self) -> Any:
        """Numba's type of it in a kernel that calls it."""
        return types.Dispatcher(self._part)


def _dispatcher(kind: Any, function: Callable[..., Any], role: str, **options: bool) -> Any:
    """Numba's compiler of ``function``, which caches its code on disk by ``role``."""
    dispatcher = kind(function, targetoptions={**_OPTIONS, **options}, pipeline_class=KernelCompiler)
    dispatcher._cache = Code(function, role)
    return dispatcher


def kernel(function: Function) -> Function:
    """Compile ``function`` on its first call, for the types of its arguments."""
    return cast(Function, _dispatcher(_Kernel, function, "called", no_cfunc_wrapper=True))


def compile_signature(signature: Any, function: Function) -> Function:
    """Compile ``function`` now for exactly ``signature``, so that it can be passed to other kernels as a value.

    Functions of one signature share one type: the kernel that receives them is compiled once and serves them all.
    """
    compiled = _dispatcher(CPUDispatcher, function, "value")
    compiled.compile(signature)
    # Another signature is then an error, and not a second, silent compilation.
    compiled.disable_compile()
    return cast(Function, compiled)
