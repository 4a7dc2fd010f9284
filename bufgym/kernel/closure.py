"""Everything that the machine code of a kernel depends on, as one hash.

The *closure* of a kernel is its own code, the kernels that it calls, theirs, and every constant that any of them reads.
Comments, docstrings and line numbers are not part of it, nor is anything that no kernel calls.
"""

from __future__ import annotations

import functools
import hashlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import llvmlite
import numba
import numpy as np

_HERE = Path(__file__).parent
TOOLS = (
    sys.implementation.cache_tag,
    numba.__version__,
    llvmlite.__version__,
    np.__version__,
    hashlib.sha256(
        b"".join((_HERE / f"{name}.py").read_bytes() for name in ("arrays", "bundle", "compile", "pipeline"))
    ).hexdigest(),
)
"""Versions of everything that translates kernels, with the sources of this package that take part."""


def closure(function: Any) -> str:
    """Hash of ``function``'s closure; equal hashes mean equal machine code, for equal types of arguments."""
    told: dict[FunctionType, str] = {}
    waiting = [function]
    while waiting:
        one = waiting.pop()
        if one not in told:
            told[one], calls = _of_one(one)
            waiting += calls
    return hashlib.sha256("".join(sorted(told.values())).encode()).hexdigest()


@functools.cache
def _of_one(function: FunctionType) -> tuple[str, list[FunctionType]]:
    """Hash of the function alone, and the functions that it names."""
    calls: list[FunctionType] = []
    parts = [function.__module__, function.__qualname__, *_code(function.__code__)]
    parts += [f"{name} = {_told(value, calls)}" for name, value in _read(function)]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest(), calls


@functools.cache
def told_types(types: Any) -> str:
    """``types``, a signature or several types, as text that names the fields of every tuple too."""
    found = [repr(types)]
    waiting = list(getattr(types, "args", types))
    while waiting:
        kind = waiting.pop()
        fields = getattr(kind, "instance_class", None)
        if fields is not None:
            found.append(f"{fields.__qualname__}{fields._fields}")
        waiting += getattr(kind, "types", ())
    return "\n".join(found)


def _code(code: CodeType) -> Iterator[str]:
    """Instructions, names and constants of ``code``, without its docstring and line numbers."""
    yield code.co_code.hex()
    yield repr((code.co_argcount, code.co_kwonlyargcount, code.co_flags, code.co_names, code.co_varnames))
    yield code.co_exceptiontable.hex()
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _code(constant)
        elif not isinstance(constant, str):  # no kernel computes with text: it is the docstring, or an error's message
            yield _told(constant, [])


def _names(code: CodeType) -> Iterator[str]:
    """Names of globals and attributes that ``code`` and the functions inside it read."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _read(function: FunctionType) -> Iterator[tuple[str, Any]]:
    """(name, value) of all outside values that ``function`` reads: globals, enclosing scopes, default arguments."""
    names = sorted(set(_names(function.__code__)))
    for name in names:
        if name in function.__globals__:
            value = function.__globals__[name]
            yield name, value
            if isinstance(value, ModuleType):
                yield from ((f"{name}.{part}", getattr(value, part)) for part in names if hasattr(value, part))
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        yield name, cell.cell_contents
    yield "defaults", (function.__defaults__, tuple(sorted((function.__kwdefaults__ or {}).items())))


def _told(value: Any, waiting: list[Any]) -> str:
    """``value`` as text that is equal for equal values in every process; functions go to ``waiting`` as well."""
    function = getattr(value, "py_func", value)
    if isinstance(function, FunctionType):
        if hasattr(value, "py_func"):
            waiting.append(function)
        return f"{function.__module__}.{function.__qualname__}"
    if isinstance(value, np.ndarray):
        return f"array {value.dtype.descr} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    if isinstance(value, tuple | list):
        return f"{type(value).__qualname__}({', '.join(_told(entry, waiting) for entry in value)})"
    if isinstance(value, frozenset | set):
        return f"set({sorted(_told(entry, waiting) for entry in value)})"
    if isinstance(value, type):
        fields = getattr(value, "_fields", ()), tuple(getattr(value, "_field_defaults", {}).items())
        return f"{value.__module__}.{value.__qualname__} {_told(fields, waiting)}"
    if isinstance(value, ModuleType):
        return value.__name__
    if hasattr(value, "__qualname__"):
        return f"{getattr(value, '__module__', '')}.{value.__qualname__}"
    return f"{type(value).__qualname__} {value!r}"
