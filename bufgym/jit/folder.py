"""The folder of machine code, and the names of kernels' code there."""

import atexit
import contextlib
import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np

from bufgym.jit.fingerprint import fingerprint
from bufgym.utils.files import PACKAGE


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
CACHED_VERSIONS = (
    16  # most files or folders of one kernel: one for each set of argument types and each state of its sources
)


def readable_name(function: Any, role: str) -> str:
    """Name of a kernel's code in the folder, without the state of its sources."""
    name = f"{function.__module__}.{function.__qualname__}-{role}"
    return "".join(letter if letter.isalnum() or letter in "._-" else "_" for letter in name)[-150:]


def state(function: Any, signature: Any, *more: Any) -> str:
    """Hash of everything that the code of ``function`` for these types depends on, now.

    Later functions of its module do not exist yet when a kernel is decorated: ask when it is compiled.
    """
    depends_on = repr((_TOOLS, fingerprint(function), spelled_types(signature), *more))
    return hashlib.sha256(depends_on.encode()).hexdigest()[:20]


def delete_old(name: str) -> None:
    """Delete a kernel's oldest code, files or folders."""
    with contextlib.suppress(OSError):  # another process may delete one of them meanwhile
        versions = sorted(Path(FOLDER).glob(f"{name}-*"), key=lambda path: path.stat().st_mtime)
        for old in versions[:-CACHED_VERSIONS]:
            shutil.rmtree(old) if old.is_dir() else old.unlink(missing_ok=True)


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


CACHED_ONLY: ContextVar[bool] = ContextVar("cached_only", default=False)


@contextlib.contextmanager
def cached_only() -> Iterator[None]:
    """Compile nothing in this block: code that is not on disk raises a ``NotCachedError``."""
    token = CACHED_ONLY.set(True)
    try:
        yield
    finally:
        CACHED_ONLY.reset(token)
