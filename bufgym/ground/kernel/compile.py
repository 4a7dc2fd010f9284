"""The one decorator for compiled functions, and what runs them."""

import functools
import threading
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import types
from numba.core.registry import CPUDispatcher
from numba.experimental.function_type import _get_wrapper_address

from bufgym.ground.kernel.cache import Code, NotKeptError, only_kept
from bufgym.ground.kernel.meanwhile import FEW, Meanwhile, is_possible
from bufgym.ground.kernel.pipeline import PartCompiler, WholeCompiler

Function = TypeVar("Function", bound=Callable[..., Any])

# Arithmetic follows IEEE 754 to the letter (no fast maths): single = batch and compiled = uncompiled, bit for bit.
# Kernels work on arrays that their caller holds, so reference counting (_nrt) is off and one kernel is inlined into the
# next: together that is five times faster. In return a kernel must neither allocate nor return an array to Python.
# Compiling takes as long as the code is that is inlined: call a large kernel from one place.
_OPTIONS = {"nopython": True, "nogil": True, "error_model": "numpy", "_nrt": False}
_INLINED = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}

_compiles_here = threading.Event()


class _Kernel(CPUDispatcher):
    """A kernel as Python calls it. Other kernels call ``inlined``, the same function without an entry from Python.

    An entry from Python repeats the whole code, and few kernels need one.
    """

    @functools.cached_property
    def inlined(self) -> Any:
        """The form that goes into other kernels."""
        return _dispatcher(CPUDispatcher, cast(Any, self).py_func, "inlined", PartCompiler, **_INLINED)

    @property
    def _numba_type_(self) -> Any:
        """Numba's type of it in a kernel that calls it."""
        return cast(Any, numba).types.Dispatcher(self.inlined)


def _dispatcher(
    kind: Any, function: Callable[..., Any], role: str, compiler: Any = WholeCompiler, **options: bool
) -> Any:
    """Numba's compiler of ``function``, which stores its code on disk by ``role``."""
    dispatcher = kind(function, targetoptions={**_OPTIONS, **options}, pipeline_class=compiler)
    dispatcher._cache = Code(function, role)
    return dispatcher


def kernel(function: Function) -> Function:
    """Compile ``function`` on its first call, for the types of its arguments."""
    return cast(Function, _dispatcher(_Kernel, function, "called", no_cfunc_wrapper=True))


def compile_for(signature: Any, function: Function) -> Function:
    """Compile ``function`` now for exactly ``signature``, so that it can be passed to other kernels as a value.

    Functions of one signature share one type: the kernel that receives them is compiled once and serves them all.
    """
    compiled = _dispatcher(CPUDispatcher, function, "value")
    compiled.compile(signature)
    compiled.disable_compile()
    return cast(Function, compiled)


def entry(compiled: Any) -> Any:
    """The plain code of a ``compile_for`` result, for callers in Python that pass exactly the types of its signature.

    To find the code for its arguments, Numba looks at every array of every tuple at each call: 3 us, and ten times that
    with functions among them. Here nobody looks, so wrong types go unnoticed.
    """
    (overload,) = compiled.overloads.values()
    return overload.entry_point


class _Direct:
    """A kernel whose first argument is a batch.

    Calls with equal ``batch.several``, and None as the last argument or not, have arguments of equal types. Over few
    rows it runs as plain Python while another process compiles it.
    """

    def __init__(self, compiled: Any) -> None:
        self.__doc__, self.py_func = compiled.__doc__, compiled.py_func
        self._compiled = compiled
        self._entries: dict[Any, Any] = {}
        self._meanwhile: dict[Any, Meanwhile] = {}

    def __call__(self, batch: Any, *arguments: Any) -> Any:
        found = self._entries.get((batch.several, arguments[-1] is None)) or self._found(batch, *arguments)
        return found(batch, *arguments)

    def compile(self, kinds: tuple[Any, ...]) -> Any:
        """The code for arguments of these types."""
        return self._compiled.compile(kinds)

    def code(self, batch: Any, last: Any) -> Any:
        """The code for such first and last arguments; this object until it is compiled."""
        return self._entries.get((batch.several, last is None), self)

    def _found(self, batch: Any, *arguments: Any) -> Any:
        kind = batch.several, arguments[-1] is None
        meanwhile = self._meanwhile.get(kind)
        is_small = len(batch[0]) <= FEW and not _compiles_here.is_set()
        if meanwhile is not None and is_small and not meanwhile.is_over:
            return meanwhile
        kinds = tuple(cast(Any, numba).typeof(argument) for argument in (batch, *arguments))
        if meanwhile is None and is_small and is_possible():
            try:
                with only_kept():
                    self._entries[kind] = self.compile(kinds)
            except NotKeptError:
                self._meanwhile[kind] = Meanwhile(self._compiled, kinds)
                return self._meanwhile[kind]
        elif meanwhile is not None:
            meanwhile.wait()
        found = self._entries[kind] = self.compile(kinds)
        return found


def compile_here() -> None:
    """Make this process finish compiling before a call goes on: for measurements, and to fill the cache."""
    _compiles_here.set()


def direct(compiled: Function) -> Function:
    """A ``kernel`` over a batch that Python calls for every step, without a look at the types of its arguments."""
    return cast(Function, _Direct(compiled))


def code_for(called: Any, batch: Any, last: Any) -> Any:
    """What to call instead of a ``direct`` kernel with such first and last arguments: .2 us less a call."""
    return called.code(batch, last) if isinstance(called, _Direct) else called


class _Located(types.WrapperAddressProtocol):
    """A compiled function together with the address of its machine code."""

    def __init__(self, function: Any, signature: Any) -> None:
        self._numba_type_ = types.FunctionType(signature)
        self._signature = signature
        self._function = function  # kept, and its code with it
        self._address = cast(Any, _get_wrapper_address)(function, signature)

    def __wrapper_address__(self) -> int:
        return int(self._address)

    def signature(self) -> Any:
        return self._signature


def located(signature: Any, compiled: Any) -> Any:
    """A ``compile_for`` result for short calls: Numba looks up its address here, not at each call.

    That saves 0.1 ms a function; in return the kernel's calls of it are slower, by a few ns.
    """
    return _Located(compiled, signature)


TRIED = (0, 68)  # The newest Numba that passed all tests; a later one is tried out


def try_out() -> None:
    """With a later Numba, run a kernel inside another. Raises an error where Numba's private parts differ."""
    if tuple(map(int, str(numba.__version__).split(".")[:2])) > TRIED:
        inner: Any = kernel(lambda array: array[1])
        outer: Any = kernel(lambda array: inner(array))
        if outer(np.arange(3)) != 1:
            raise ValueError("a wrong result")
