"""The one decorator for compiled functions, and what Python calls them by."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.core import types
from numba.core.registry import CPUDispatcher
from numba.experimental.function_type import _get_wrapper_address

from bufgym.jit.cache import Code
from bufgym.jit.pipeline import KernelCompiler

Function = TypeVar("Function", bound=Callable[..., Any])

# Arithmetic follows IEEE 754 to the letter (no fast maths): single = batch and compiled = uncompiled, bit for bit.
# Kernels work on arrays that their caller holds, so reference counting (_nrt) is off and one kernel is inlined into the
# next: together that is five times faster. In return a kernel must neither allocate nor return an array to Python.
# Compiling takes as long as the code is that is inlined: call a large kernel from one place.
_OPTIONS = {"nopython": True, "nogil": True, "error_model": "numpy", "_nrt": False}
_INLINED = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}


class _Kernel(CPUDispatcher):
    """A kernel as Python calls it. Other kernels call a second form, without the entry from Python.

    That entry repeats the whole code, and few kernels need one.
    """

    @functools.cached_property
    def _part(self) -> Any:
        options, part = {**_OPTIONS, **_INLINED}, cast(Any, CPUDispatcher)
        return part(cast(Any, self).py_func, targetoptions=options, pipeline_class=KernelCompiler)

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


def entry_point_of(compiled: Any) -> Any:
    """The plain code of a ``compile_signature`` result, for callers that pass exactly the types of its signature.

    To find the code for its arguments, Numba looks at every array of every tuple at each call: 3 us, and ten times that
    with functions among them. Here nobody looks, so wrong types go unnoticed.
    """
    (overload,) = compiled.overloads.values()
    return overload.entry_point


def without_dispatch(compiled: Any) -> Any:
    """A ``kernel`` over a batch that Python calls for every step, without a look at the types of its arguments.

    It has two arguments or more. Calls with equal ``batch.several``, and None as the same of the last two arguments,
    have arguments of equal types.
    """
    entries: dict[tuple[bool | None, bool, bool], Any] = {}

    @functools.wraps(compiled.py_func)
    def call(*arguments: Any) -> Any:
        kind = arguments[0].several, arguments[-1] is None, arguments[-2] is None
        if kind not in entries:
            entries[kind] = compiled.compile(tuple(map(cast(Any, numba).typeof, arguments)))
        return entries[kind](*arguments)

    cast(Any, call).py_func = compiled.py_func
    return call


class _Located(types.WrapperAddressProtocol):
    """A compiled function together with the address of its machine code."""

    def __init__(self, signature: Any, compiled: Any) -> None:
        self._numba_type_ = types.FunctionType(signature)
        self._signature = signature
        self._compiled = compiled  # the address is valid only as long as this lives
        self._address = int(cast(Any, _get_wrapper_address)(compiled, signature))

    def __wrapper_address__(self) -> int:
        return self._address

    def signature(self) -> Any:
        return self._signature


def with_address(signature: Any, compiled: Any) -> Any:
    """A ``compile_signature`` result for short calls: Numba looks up its address here, not at each call.

    That saves 0.1 ms a function; in return the kernel's calls of it are slower, by a few ns.
    """
    return _Located(signature, compiled)
