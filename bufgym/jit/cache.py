"""Storage of machine code: a file for each kernel, set of argument types, and state of all that it calls."""

import atexit
import contextlib
import hashlib
import os
import pickle
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any, cast

import llvmlite
import numba
import numpy as np
from numba.core import compiler, serialize

from bufgym.jit.fingerprint import fingerprint
from bufgym.utils.files import PACKAGE, replaced


def _is_writable(folder: Path) -> bool:
    """Whether files can be written in ``folder``, which is made if missing."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK)


def _cache_folder() -> str:
    """Choose the folder for machine code: ``NUMBA_CACHE_DIR``, beside the package, or in the user's cache.

    If none can be written, this process and its children share a new one, whose name nobody can foresee.
    """
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    places = PACKAGE / "__pycache__", Path(home) / "bufgym"
    parent = os.environ.get("NUMBA_CACHE_DIR") or next(filter(_is_writable, places), None)
    if parent is None:
        parent = os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp(prefix="bufgym-")
        atexit.register(shutil.rmtree, parent, ignore_errors=True)
        print(
            "bufgym: compiled code cannot be cached, as neither the package nor the cache folder can be written; "
            "set NUMBA_CACHE_DIR to a folder that can",
            file=sys.stderr,
        )
    return str(Path(parent, "kernels"))


FOLDER = _cache_folder()
"""Folder for machine code."""

_COMPILER = [hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted(Path(__file__).parent.glob("*.py"))]
_TOOLS = (sys.implementation.cache_tag, numba.__version__, llvmlite.__version__, np.__version__, *_COMPILER)
"""Versions of all that translates kernels, and the sources of this package."""
_CACHED_VERSIONS = 16  # most files of one kernel: one for each set of argument types and each state of its sources


class Code:
    """Machine code of one kernel on disk, a file for each set of argument types.

    A file is named by everything that its code depends on (see ``fingerprint``). So processes that compile side by side
    never write different code into one file, and code of an earlier source is never found. A damaged file is compiled
    anew. If no file can be written, nothing is cached.
    """

    def __init__(self, function: Any, role: str) -> None:
        self._function = function
        name = f"{function.__module__}.{function.__qualname__}-{role}"
        self._name = "".join(letter if letter.isalnum() or letter in "._-" else "_" for letter in name)[-150:]

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Code compiled for the types of ``signature``, or None if there is none."""
        # Rebuilt code finds its functions by name, also those of modules imported since Numba last looked.
        target.refresh()
        try:
            cached = pickle.loads(self._file(signature, target.codegen()).read_bytes())
            return cast(Any, compiler).CompileResult._rebuild(target, *cached)
        except Exception:  # a file that is missing, or cut short, which ends in many kinds of error
            if _CACHED_ONLY.get():
                raise NotCachedError from None
            return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Cache the code that was compiled for the types of ``signature``."""
        if result.lifted or result.library.has_dynamic_globals:  # it holds addresses of this process
            return
        file = self._file(signature, result.codegen)
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            # Whole or not at all: another process may read it at this moment.
            with replaced(file) as part:
                part.write_bytes(cast(Any, serialize).dumps(result._reduce()))
            # Another process may delete one of them meanwhile; that is an OSError, too, and does no harm.
            versions = sorted(file.parent.glob(f"{self._name}-*.nbc"), key=lambda path: path.stat().st_mtime)
            for old in versions[:-_CACHED_VERSIONS]:
                old.unlink(missing_ok=True)

    def _file(self, signature: Any, generator: Any) -> Path:
        # The fingerprint now, as the module's later functions did not exist when the kernel was decorated.
        depends_on = repr((_TOOLS, fingerprint(self._function), spelled_types(signature), generator.magic_tuple()))
        return Path(FOLDER, f"{self._name}-{hashlib.sha256(depends_on.encode()).hexdigest()[:20]}.nbc")


def spelled_types(types: Any) -> str:
    """``types``, a signature or several types, in words that name the fields of every tuple too."""
    found, waiting = [repr(types)], list(getattr(types, "args", types))
    while waiting:
        kind = waiting.pop()
        found.append(str(getattr(getattr(kind, "instance_class", None), "_fields", "")))
        waiting += getattr(kind, "types", ())
    return "\n".join(found)


class NotCachedError(Exception):
    """The requested code must be compiled first."""


_CACHED_ONLY: ContextVar[bool] = ContextVar("cached_only", default=False)


@contextlib.contextmanager
def cached_only() -> Iterator[None]:
    """Compile nothing in this block: code that is not on disk raises a ``NotCachedError``."""
    token = _CACHED_ONLY.set(True)
    try:
        yield
    finally:
        _CACHED_ONLY.reset(token)
