"""Calls of kernels from Python, and the decorator that makes them."""

import contextlib
import ctypes
import functools
import inspect
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any, TypeVar, cast

from bufgym.jit.arrays import readable
from bufgym.jit.way import JIT, WAY, C
from bufgym.kernels.kinds import KernelError, Pointer

Function = TypeVar("Function", bound=Callable[..., Any])
_key_of: Callable[[Any], Any] | None = None
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


def _values_key() -> Callable[[Any], Any]:
    """``values.key_of``, which is imported with the first call and then kept: an import takes as long as the call."""
    global _key_of
    from bufgym.jit.values import key_of

    _key_of = key_of
    return key_of


class Call:
    """One call of a kernel, ready to be made again and again: of C, the same arrays and the same numbers."""

    __slots__ = "_address", "_arguments", "_code", "_copies", "_function", "_kept", "_words"

    def __init__(self, code: Any, function: Any, arguments: tuple[Any, ...]) -> None:
        self._code, self._function, self._arguments = code, function, arguments
        if code is not None:
            self._words, self._kept, self._copies = code.words(arguments)
            self._address = ctypes.addressof(self._words)

    @property
    def plain(self) -> Callable[[], Any] | None:
        """The call of C alone, where there is nothing to look at afterwards."""
        if self._code is None or self._copies or self._code.result is not None or WAY != C:
            return None
        return functools.partial(self._code.run, self._address)

    def __call__(self) -> Any:
        """Make the call; return the kernel's result."""
        if self._code is None:
            with in_python():
                return self._function(*map(readable, self._arguments))
        for copy, array in self._copies:
            copy[...] = array
        code = self._code
        fault = code.run(self._address)
        for copy, array in self._copies:
            if array.flags.writeable:
                array[...] = copy
        if fault:
            raise KernelError(fault.decode())
        if code.result is None:
            return None
        return self._words.result if code.gives_number else code.value_of(self._words.result)


class Kernel:
    """A function that other kernels call in C, and Python through here."""

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self._codes: dict[Any, Any] = {}
        self._arguments = cast(Any, function).__code__.co_argcount

    def __call__(self, *arguments: Any, **named_ones: Any) -> Any:
        """Call it; its code is looked up, or made, at the first call with arguments of such kinds."""
        if getattr(_here, "python", False):
            return self.py_func(*arguments, **named_ones)
        return self.bound(*arguments, **named_ones)()

    def bound(self, *arguments: Any, **named_ones: Any) -> Call:
        """The call with these arguments, to be made later, and more than once."""
        if named_ones or len(arguments) != self._arguments:
            signature = inspect.signature(self.py_func).bind(*arguments, **named_ones)
            signature.apply_defaults()
            arguments = signature.args
        return Call(self.code(arguments), self.py_func, arguments)

    def code(self, arguments: tuple[Any, ...], ready: bool = False) -> Any:
        """The code for arguments of such kinds; None where it runs as Python, or, if it must be ``ready``, is not."""
        key = tuple(map(_key_of or _values_key(), arguments))
        return self._codes[key] if key in self._codes else self._found(key, arguments, ready)

    def _found(self, key: Any, arguments: tuple[Any, ...], ready: bool) -> Any:
        from bufgym.jit import code
        from bufgym.jit.values import annotated, kind_of

        # C has no way to call one without an address.
        if code.noted is None and any(isinstance(a, Hook) and a.address is None for a in arguments):
            return None
        hints = inspect.get_annotations(self.py_func)
        names = cast(Any, self.py_func).__code__.co_varnames
        kinds = tuple(annotated(kind_of(a), hints.get(n)) for a, n in zip(arguments, names, strict=False))
        found = code.entry(self.py_func, kinds, ready)
        if found is not None or not ready:
            self._codes[key] = found
        return found

    def __getstate__(self) -> dict[str, Any]:
        """A copy of it, or one in another process, finds its code anew."""
        return self.__dict__ | {"_codes": {}}

    def __repr__(self) -> str:
        return f"<kernel {self.py_func.__module__}.{self.py_func.__qualname__}>"


class Hook:
    """A function that kernels call through its address."""

    def __init__(self, function: Callable[..., Any], pointer: Pointer) -> None:
        functools.update_wrapper(self, function)
        function = getattr(function, "py_func", function)
        from bufgym.jit.code import address

        self.py_func, self.kind = function, pointer
        self.address: int | None = address(function, pointer)
        self.key = str(pointer) if self.address is not None else f"{pointer} without an address"
        self._kernel = Kernel(function)

    def __reduce__(self) -> tuple[Any, ...]:
        """An address holds in its own process alone."""
        return Hook, (self.py_func, self.kind)

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

    It remembers the last ``MOST`` calls, as results go into a few arrays in turn. A copy of it, or one in another
    process, remembers none.
    """

    MOST = 16

    def __init__(self) -> None:
        self._calls: dict[tuple[int, ...], tuple[Any, Callable[[], Any]]] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return Repeated, ()

    def __call__(self, function: Any, *arguments: Any) -> Any:
        """``function(*arguments)``; arguments that were the same objects in one of the last calls are not looked at."""
        key = tuple(map(id, arguments))
        call = self._calls.get(key)
        return call[1]() if call is not None and call[0][0] is function else self._new(key, function, arguments)()

    def _new(self, key: tuple[int, ...], function: Any, arguments: tuple[Any, ...]) -> Callable[[], Any]:
        if not isinstance(function, Kernel) or getattr(_here, "python", False):
            return functools.partial(function, *arguments)
        call = function.bound(*arguments)
        while len(self._calls) >= self.MOST:
            del self._calls[next(iter(self._calls))]
        # The call owns what C reads; arguments that are kept share their address with no other object.
        self._calls[key] = (function, arguments, call), call.plain or call
        return self._calls[key][1]


def say_once(text: str) -> None:
    """Write a line to stderr, once in a process."""
    if text not in _said and sys.stderr is not None:
        _said.add(text)
        sys.stderr.write(f"bufgym: {text}\n")


_said: set[str] = set()
