"""The decorator for compiled functions, with plain Numba: for versions that the pipeline does not know.

It keeps to what Numba documents, options apart. See docs/methods.md, "Kernels in parts".
"""

import contextlib
import functools
import shutil
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numba.extending
from llvmlite import binding
from numba.core import compiler, untyped_passes

from bufgym.jit import announce
from bufgym.jit.folder import CACHED_ONLY, FOLDER, NotCachedError, delete_old, readable_name, state
from bufgym.jit.none_fields import NoneFields

Function = TypeVar("Function", bound=Callable[..., Any])

_numba: Any = numba  # It has no types.

_Compiler: Any = compiler.CompilerBase


class _PlainCompiler(_Compiler):  # type: ignore[misc]
    """Numba's own passes, and ``NoneFields`` before all that look at types."""

    def define_pipelines(self) -> list[Any]:
        """All passes, in order."""
        passes = cast(Any, compiler).DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.add_pass_after(NoneFields, untyped_passes.IRProcessing)
        passes.finalize()
        return [passes]


# As in ``compile``, which says why.
_OPTIONS = {"nogil": True, "error_model": "numpy", "_nrt": False, "pipeline_class": _PlainCompiler}
_PART = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_CPU = binding.get_host_cpu_name(), binding.get_host_cpu_features().flatten()
_FOLDER_LOCK = threading.Lock()


class _Kernel:
    """A kernel as Python calls it, ``whole``. Other kernels call its ``part``, without the entry from Python."""

    def __init__(self, function: Any) -> None:
        self.py_func = function
        self.whole = _cached(_numba.njit(**_OPTIONS, no_cfunc_wrapper=True)(function), "called")
        self.compile = self.whole.compile
        functools.update_wrapper(cast(Any, self), function)

    @functools.cached_property
    def part(self) -> Any:
        """The form that other kernels call."""
        return _numba.njit(**_OPTIONS, **_PART)(self.py_func)

    @property
    def overloads(self) -> Any:
        """Types of arguments -> compiled code."""
        return self.whole.overloads

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self.whole(*arguments, **named)

    def __reduce__(self) -> Any:
        return kernel, (self.py_func,)


def _type_in_kernels(compiled: _Kernel, _: Any) -> Any:
    """Numba's type of a kernel in a kernel that calls it."""
    return _numba.typeof(compiled.part)


_numba.extending.typeof_impl.register(_Kernel)(_type_in_kernels)


def _cached(dispatcher: Any, role: str) -> Any:
    """``dispatcher`` with its code on disk, a folder for each set of argument types and state of all that it calls.

    Numba's own cache looks at one file of sources, so code of an earlier state of another would be found in one folder.
    """
    function, compile_uncached = dispatcher.py_func, dispatcher.compile
    name = readable_name(function, role)

    def compile_cached(signature: Any) -> Any:
        if tuple(getattr(signature, "args", signature)) in dispatcher.overloads:
            return compile_uncached(signature)
        folder = Path(FOLDER, f"{name}-{state(function, signature, _CPU)}")
        is_cached = any(folder.rglob("*.nbc"))
        if CACHED_ONLY.get() and not is_cached:
            raise NotCachedError
        with contextlib.nullcontext() if is_cached else announce.compiling(), warnings.catch_warnings():
            warnings.simplefilter("ignore", _numba.core.errors.NumbaWarning)  # of code that cannot be cached
            try:
                _use(folder, dispatcher)
                result = compile_uncached(signature)
            except _numba.core.errors.NumbaError:
                raise
            except Exception:  # a file cut short, which ends in many kinds of error, or a disk that is full
                shutil.rmtree(folder, ignore_errors=True)
                if CACHED_ONLY.get():
                    raise NotCachedError from None
                with contextlib.suppress(Exception):
                    _use(folder, dispatcher)
                result = compile_uncached(signature)
        if not is_cached:
            delete_old(name)
        return result

    dispatcher.compile = compile_cached
    return dispatcher


def _use(folder: Path, dispatcher: Any) -> None:
    """Make Numba look for the code of ``dispatcher`` in ``folder``, and write it there."""
    with _FOLDER_LOCK:  # the setting is one of the process
        before, _numba.config.CACHE_DIR = _numba.config.CACHE_DIR, str(folder)
        try:
            dispatcher.enable_caching()
        finally:
            _numba.config.CACHE_DIR = before


def kernel(function: Function) -> Function:
    """Compile ``function`` on its first call, for the types of its arguments."""
    return cast(Function, _Kernel(function))


def compile_signature(signature: Any, function: Function) -> Function:
    """Compile ``function`` now for exactly ``signature``, so that it can be passed to other kernels as a value.

    Functions of one signature share one type: the kernel that receives them is compiled once and serves them all.
    """
    compiled = _cached(_numba.njit(**_OPTIONS)(function), "value")
    compiled.compile(signature)
    # Another signature is then an error, and not a second, silent compilation.
    compiled.disable_compile()
    return cast(Function, compiled)
