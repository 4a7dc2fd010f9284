"""Calls of kernels from Python, and the decorator that makes them."""

import contextlib
import ctypes
import functools
import inspect
import operator
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any, TypeVar, cast

import numpy as np

from bufgym.jit.arrays import named
from bufgym.jit.way import JIT, WAY, C
from bufgym.kernels.kinds import KernelError, Pointer

Function = TypeVar("Function", bound=Callable[..., Any])
_here = threading.local()
"""Whether this thread runs a kernel in Python, whose calls of others stay in Python."""


@contextlib.contextmanager
def in_python() -> Iterator[None]:
    """Run kernels as Python in this block."""
    before = getattr(_here, "python", False)
    _here.python = True
    try:
        yield
    finally:
        _here.python = before


def _readable(value: Any) -> Any:
    """A value whose records are read by attributes in plain Python."""
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return named(cast(Any, value))
    if isinstance(value, np.ndarray) and value.dtype.names:
        return value.view(np.recarray)
    return value.view((np.record, value.dtype)) if type(value) is np.void else value


class Call:
    """One call of a kernel, ready to be made again and again: of C, the same arrays and the same numbers."""

    plain: Callable[[], Any] | None = None
    """The call of C alone, where it gives nothing back."""

    def __init__(self, code: Any, function: Any, arguments: tuple[Any, ...]) -> None:
        self._code, self._function, self._arguments = code, function, arguments
        if code is not None:
            from bufgym.jit.values import struct_of, words

            kept: list[Any] = []
            self._words = struct_of(code.kinds, False, code.result)(*words(code.kinds, arguments, kept))
            self._kept, self._address, self._run = kept, ctypes.addressof(self._words), code.run
            self._copies = [pair for pair in kept if isinstance(pair, tuple)]
            if not self._copies and code.result is None and WAY == C:
                # Nothing to look at afterwards. The words live as long as the partial does.
                self.plain = functools.partial(code.run, self._address)
                cast(Any, self.plain).words, cast(Any, self.plain).kept = self._words, {-1: kept}

    def put(self, k: int, before: Any, now: Any) -> bool:
        """Take another value for the k-th argument; False if it must be prepared as a whole."""
        from bufgym.jit.values import fields, key_of, words

        if self.plain is None or isinstance(now, Hook) or key_of(before) != key_of(now):
            return False
        kinds, kept = self._code.kinds, list[Any]()
        made = words(kinds[k : k + 1], (now,), kept)
        if any(isinstance(one, tuple) for one in kept):
            return False
        first = sum(len(fields(kind, False)) for kind in kinds[:k])
        for j, word in enumerate(made, first):
            setattr(self._words, f"w{j}", word)
        cast(Any, self.plain).kept[k] = kept
        return True

    def __call__(self) -> Any:
        """Make the call; return the kernel's result."""
        if self._code is None:
            with in_python():
                return self._function(*map(_readable, self._arguments))
        for copy, array in self._copies:
            copy[...] = array
        fault = self._run(self._address)
        for copy, array in self._copies:
            if array.flags.writeable:
                array[...] = copy
        if fault:
            raise KernelError(fault.decode())
        if self._code.result is None:
            return None
        from bufgym.jit.values import value_of

        return value_of(self._code.result, self._words.result)


class Kernel:
    """A function that other kernels call in C, and Python through here."""

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self._codes: dict[Any, Any] = {}

    def __call__(self, *arguments: Any, **named_ones: Any) -> Any:
        """Call it; its code is looked up, or made, at the first call with arguments of such kinds."""
        if getattr(_here, "python", False):
            return self.py_func(*arguments, **named_ones)
        return self.bound(*arguments, **named_ones)()

    def bound(self, *arguments: Any, **named_ones: Any) -> Call:
        """The call with these arguments, to be made later, and more than once."""
        if named_ones or len(arguments) != cast(Any, self.py_func).__code__.co_argcount:
            signature = inspect.signature(self.py_func).bind(*arguments, **named_ones)
            signature.apply_defaults()
            arguments = signature.args
        return Call(self.code(arguments), self.py_func, arguments)

    def code(self, arguments: tuple[Any, ...], ready: bool = False) -> Any:
        """The code for arguments of such kinds; None where it runs as Python, or, if it must be ``ready``, is not."""
        from bufgym.jit import code
        from bufgym.jit.values import annotated, key_of, kind_of

        # One without an address must not meet the code for those that have one.
        if code.noted is None and any(isinstance(a, Hook) and a.address is None for a in arguments):
            return None
        key = tuple(map(key_of, arguments))
        if key not in self._codes:
            hints = inspect.get_annotations(self.py_func)
            names = cast(Any, self.py_func).__code__.co_varnames
            kinds = tuple(annotated(kind_of(a), hints.get(n)) for a, n in zip(arguments, names, strict=False))
            found = code.entry(self.py_func, kinds, ready)
            if found is None and ready:
                return None
            self._codes[key] = found
        return self._codes[key]

    def __repr__(self) -> str:
        return f"<kernel {self.py_func.__module__}.{self.py_func.__qualname__}>"


class Hook:
    """A function that kernels call through its address."""

    def __init__(self, function: Callable[..., Any], pointer: Pointer) -> None:
        functools.update_wrapper(self, function)
        function = getattr(function, "py_func", function)
        self.py_func, self.kind, self.key = function, pointer, str(pointer)
        from bufgym.jit.code import address

        self.address: int | None = address(function, pointer)
        self._kernel = Kernel(function)

    def __call__(self, *arguments: Any) -> Any:
        """Call it from Python, as the kernel that it is."""
        return self._kernel(*arguments)


def kernel(function: Function) -> Function:
    """Make ``function`` a kernel; in plain Python it stays what it is."""
    return cast(Function, Kernel(function)) if JIT else function


def compile_signature(kinds: Pointer | None, function: Function) -> Function:
    """``function`` with an address, to be passed to kernels as a value: they serve all functions of these kinds."""
    return cast(Function, Hook(function, kinds)) if JIT and kinds else function


class Repeated:
    """Calls of a kernel with mostly the same arguments: to look at all arrays takes longer than most kernels run.

    A copy, or one in another process, looks at them anew.
    """

    def __init__(self) -> None:
        self._function: Any = None
        self._arguments: tuple[Any, ...] = ()
        self._call: Any = None
        self._run: Callable[[], Any] = tuple

    def __reduce__(self) -> tuple[Any, ...]:
        return Repeated, ()

    def __call__(self, function: Any, *arguments: Any) -> Any:
        """``function(*arguments)``; only arguments that are other objects than the last time are looked at."""
        if function is not self._function or any(map(operator.is_not, arguments, self._arguments)):
            self._take(function, arguments)
        return self._run()

    def _take(self, function: Any, arguments: tuple[Any, ...]) -> None:
        """Prepare the call with these arguments."""
        before = self._arguments
        known, self._function = self._function, None  # whatever fails now: the next call looks at all again
        if (
            self._call is None
            or function is not known
            or not all(
                one is other or self._call.put(k, one, other)
                for k, (one, other) in enumerate(zip(before, arguments, strict=True))
            )
        ):
            if isinstance(function, Kernel) and not getattr(_here, "python", False):
                self._call = function.bound(*arguments)
                self._run = self._call.plain or self._call
            else:
                self._call, self._run = None, functools.partial(function, *arguments)
        self._function, self._arguments = function, arguments


def say_once(text: str) -> None:
    """Write a line to stderr, once in a process."""
    if text not in _said and sys.stderr is not None:
        _said.add(text)
        sys.stderr.write(f"bufgym: {text}\n")


_said: set[str] = set()
