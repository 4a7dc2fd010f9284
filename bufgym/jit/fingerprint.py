"""Everything that the machine code of a kernel depends on, as one hash.

The *fingerprint* of a kernel is a hash of its own code, the kernels that it calls, theirs, and every constant that any
of them reads. Comments and line numbers are not part of it, nor is anything that no kernel calls.
"""

import functools
import hashlib
from collections.abc import Iterator
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np

_VERSIONED = ("numpy",)
"""Packages whose functions become no code."""


def fingerprint(function: Any) -> str:
    """Hash of all that ``function`` depends on: equal where its machine code is, for equal types of its arguments."""
    texts: dict[FunctionType, str] = {}
    waiting = [function]
    while waiting:
        one = waiting.pop()
        if one not in texts:
            texts[one], calls = _of_one(one)
            waiting += calls
    # Sorted: which function is found first must not count.
    return hashlib.sha256("".join(sorted(texts.values())).encode()).hexdigest()


@functools.cache
def _of_one(function: FunctionType) -> tuple[str, list[FunctionType]]:
    """(Hash of the function alone, the functions that it names)."""
    calls: list[FunctionType] = []
    names: set[str] = set()
    parts = [function.__module__, function.__qualname__, *_code(function.__code__, names)]
    parts += [f"{name} = {_described(value, calls)}" for name, value in _read(function, sorted(names))]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest(), calls


def _code(code: CodeType, names: set[str]) -> Iterator[str]:
    """Instructions and constants of ``code`` and the functions inside it, whose names go to ``names``."""
    names.update(code.co_names)
    yield repr((code.co_code, code.co_exceptiontable, code.co_argcount, code.co_flags, code.co_names, code.co_varnames))
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _code(constant, names)
        else:
            yield _described(constant, [])


def _read(function: FunctionType, names: list[str]) -> Iterator[tuple[str, Any]]:
    """(name, value) of all that ``function`` reads from outside: globals, enclosing scopes, default arguments."""
    waiting = [(name, function.__globals__[name]) for name in names if name in function.__globals__]
    while waiting:
        name, value = waiting.pop()
        yield name, value
        # Modules may import each other in a circle; no kernel reads deeper than a.b.c.d.
        if isinstance(value, ModuleType) and name.count(".") < 4:
            held = vars(value)
            waiting += [(f"{name}.{part}", held[part]) for part in names if part in held]
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        yield name, cell.cell_contents
    yield "defaults", (function.__defaults__, tuple(sorted((function.__kwdefaults__ or {}).items())))


def _described(value: Any, waiting: list[Any]) -> str:
    """``value`` in words that are equal for equal values in every process; functions go to ``waiting`` as well."""
    function = getattr(value, "py_func", value)
    if isinstance(function, FunctionType) and function.__module__.partition(".")[0] not in _VERSIONED:
        waiting.append(function)
    if isinstance(value, np.ndarray):
        return f"array {value.dtype.descr} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    if isinstance(value, tuple | list):
        return f"{type(value).__qualname__}({', '.join(_described(item, waiting) for item in value)})"
    if isinstance(value, frozenset | set):
        return f"set({sorted(_described(item, waiting) for item in value)})"
    if isinstance(value, type):
        fields = tuple(getattr(value, name, None) for name in ("_fields", "__members__"))
        defaults = tuple(getattr(value, "_field_defaults", {}).items())
        return f"{value.__module__}.{value.__qualname__} {fields} {_described(defaults, waiting)}"
    if isinstance(value, ModuleType):
        return value.__name__
    if hasattr(function, "__qualname__"):
        return f"{getattr(function, '__module__', '')}.{function.__qualname__}"
    return f"{type(value).__qualname__} {value!r}"
