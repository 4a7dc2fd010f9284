"""Everything that the machine code of a kernel depends on, as one hash.

The *closure* of a kernel is its own code, the kernels that it calls, theirs, and every constant that any of them reads.
Comments, docstrings and line numbers are not part of it, nor is anything that no kernel calls.
"""

import enum
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
        b"".join(
            (_HERE / f"{name}.py").read_bytes() for name in ("arrays", "compile", "indexing", "none_fields", "pipeline")
        )
    ).hexdigest(),
)
"""Versions of all that translates kernels, with the sources of this package that take part."""
_VERSIONED = ("numba", "numpy", "llvmlite")
_HAS_DOCSTRING = 0x4000000  # A flag of code from Python 3.13 on


def closure(function: Any) -> str:
    """Hash of ``function``'s closure: equal where its machine code is, for equal types of its arguments."""
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
    """(Hash of the function alone, the functions that it names)."""
    calls: list[FunctionType] = []
    parts = [function.__module__, function.__qualname__, *_code(function.__code__)]
    parts += [f"{name} = {_told(value, calls)}" for name, value in _read(function)]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest(), calls


@functools.cache
def told_types(types: Any) -> str:
    """``types``, a signature or several types, in words that name the fields of every tuple too."""
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
    flags = code.co_flags & ~_HAS_DOCSTRING
    yield repr((code.co_argcount, code.co_kwonlyargcount, flags, code.co_names, code.co_varnames))
    yield code.co_exceptiontable.hex()
    for constant in code.co_consts[1 if _has_docstring(code) else 0 :]:
        if isinstance(constant, CodeType):
            yield from _code(constant)
        else:
            yield _told(constant, [])


def _has_docstring(code: CodeType) -> bool:
    """Whether the first constant is a docstring."""
    if sys.version_info >= (3, 13):
        return bool(code.co_flags & _HAS_DOCSTRING)
    # Before, a function without a docstring begins with None; other code, such as a lambda's, has none.
    return not code.co_name.startswith("<") and isinstance((*code.co_consts, None)[0], str)


def _names(code: CodeType) -> Iterator[str]:
    """Names of globals and attributes that ``code`` and the functions inside it read."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _read(function: FunctionType) -> Iterator[tuple[str, Any]]:
    """(name, value) of all that ``function`` reads from outside: globals, enclosing scopes, default arguments."""
    names = sorted(set(_names(function.__code__)))
    for name in names:
        if name in function.__globals__:
            value = function.__globals__[name]
            yield name, value
            if isinstance(value, ModuleType):
                yield from _attributes(name, value, names)
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        yield name, cell.cell_contents
    yield "defaults", (function.__defaults__, tuple(sorted((function.__kwdefaults__ or {}).items())))


def _attributes(name: str, module: ModuleType, names: list[str], depth: int = 3) -> Iterator[tuple[str, Any]]:
    """(dotted name, value) of all attributes with one of ``names``, in modules inside the module too."""
    for part in names:
        if hasattr(module, part):
            value = getattr(module, part)
            yield f"{name}.{part}", value
            if isinstance(value, ModuleType) and depth > 0:
                yield from _attributes(f"{name}.{part}", value, names, depth - 1)


def _told(value: Any, waiting: list[Any]) -> str:
    """``value`` in words that are equal for equal values in every process; functions go to ``waiting`` as well."""
    function = getattr(value, "py_func", value)
    if isinstance(function, FunctionType):
        if function.__module__.partition(".")[0] not in _VERSIONED:  # the body counts, of numba.extending's helpers too
            waiting.append(function)
        return f"{function.__module__}.{function.__qualname__}"
    if isinstance(value, np.ndarray):
        return f"array {value.dtype.descr} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    if isinstance(value, tuple | list):
        return f"{type(value).__qualname__}({', '.join(_told(entry, waiting) for entry in value)})"
    if isinstance(value, frozenset | set):
        return f"set({sorted(_told(entry, waiting) for entry in value)})"
    if isinstance(value, type) and issubclass(value, enum.Enum):
        return f"{value.__module__}.{value.__qualname__} {[(one.name, one.value) for one in value]}"
    if isinstance(value, type):
        fields = getattr(value, "_fields", ()), tuple(getattr(value, "_field_defaults", {}).items())
        return f"{value.__module__}.{value.__qualname__} {_told(fields, waiting)}"
    if isinstance(value, ModuleType):
        return value.__name__
    if hasattr(value, "__qualname__"):
        return f"{getattr(value, '__module__', '')}.{value.__qualname__}"
    return f"{type(value).__qualname__} {value!r}"
