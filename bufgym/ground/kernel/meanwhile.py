"""Kernels as plain Python, while another process compiles them.

A kernel and its source give the same results bit for bit. So a kernel over few rows need not wait for the compiler: it
runs as plain Python, a thousand times slower, until its machine code is on disk.
"""

import contextlib
import importlib
import os
import pickle
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import Any, cast

import filelock
import numpy as np
from numba.core import serialize
from numba.core.registry import CPUDispatcher

from bufgym.ground.kernel.announce import say
from bufgym.ground.kernel.arrays import named
from bufgym.ground.kernel.cache import FOLDER
from bufgym.ground.processes import COMPILES, compiling

FEW = 8  # Rows of a batch that plain Python is fast enough for


class Meanwhile:
    """A process that compiles ``compiled`` for arguments of these types, and the same kernel as plain Python."""

    def __init__(self, compiled: Any, kinds: tuple[Any, ...]) -> None:
        function = compiled.py_func
        self._python = plain(function)
        self._asked = cast(Any, serialize).dumps((function.__module__, function.__name__, kinds))
        say()
        self._thread = threading.Thread(target=self._compile, daemon=True)
        self._thread.start()

    @property
    def is_over(self) -> bool:
        """Whether the process has ended: then the code is on disk, or has to be compiled here."""
        return not self._thread.is_alive()

    def wait(self) -> None:
        """Return once the process has ended."""
        self._thread.join()

    def __call__(self, *arguments: Any) -> Any:
        """Run the kernel as plain Python."""
        with np.errstate(all="ignore"):  # as compiled code does
            return self._python(*(named(entry) if hasattr(entry, "_fields") else entry for entry in arguments))

    def _compile(self) -> None:
        with contextlib.suppress(OSError):  # where no process can be started, is_over says so
            compiling(__name__, "fill_cache", given=self._asked, quiet=True)


def is_possible() -> bool:
    """Whether another process can compile: not in a program that is one file with its Python, such as PyInstaller's."""
    return bool(sys.executable) and not getattr(sys, "frozen", False) and COMPILES not in os.environ


def fill_cache() -> None:
    """Compile the kernel that standard input names, and leave it on disk."""
    module, name, kinds = pickle.load(sys.stdin.buffer)
    # One process compiles at a time; those that wait find its code.
    Path(FOLDER).mkdir(parents=True, exist_ok=True)
    with filelock.FileLock(Path(FOLDER, f"{module}.{name}.lock")):
        getattr(importlib.import_module(module), name).compile(kinds)


_GLOBALS: dict[str, dict[str, Any]] = {}
_LOCK = threading.RLock()


def plain(function: Any) -> Callable[..., Any]:
    """A kernel's ``function`` as plain Python, which calls other kernels as plain Python too."""
    with _LOCK:
        seen = _plain_globals(function.__module__)
    return FunctionType(function.__code__, seen, function.__name__, function.__defaults__, function.__closure__)


def _plain_globals(module: str) -> dict[str, Any]:
    """What the functions of ``module`` see, with plain Python in place of every kernel."""
    if module not in _GLOBALS:
        found = _GLOBALS[module] = dict(vars(sys.modules[module]))
        for name, value in found.items():
            if isinstance(value, CPUDispatcher):
                found[name] = plain(cast(Any, value).py_func)
    return _GLOBALS[module]
