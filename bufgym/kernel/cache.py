"""Where machine code is kept: a folder for exactly this state of the package's sources."""

from __future__ import annotations

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
from typing import Any, cast

import numba
from numba.core import caching

JIT = not cast(Any, numba.config).DISABLE_JIT
"""False where compilation is off and every kernel runs as its Python source."""

_PACKAGE = Path(__file__).resolve().parents[1]


def _sources() -> dict[Path, bytes]:
    """Every source that compiled code rests on: those with kernels, the modules whose names they import, and this."""
    texts = {path.relative_to(_PACKAGE): path.read_bytes() for path in sorted(_PACKAGE.rglob("*.py"))}
    sources = {
        path: text for path, text in texts.items() if b"bufgym.kernel import" in text or path.parts[0] == "kernel"
    }
    for text in list(sources.values()):
        for line in text.decode().split("\nfrom bufgym")[1:]:
            module, names = line.split(" import ", 1)
            place = Path(*module.split("."))
            names = names[1 : names.index(")")] if names.startswith("(") else names.split("\n", 1)[0]
            files = [place / f"{name.strip()}.py" for name in names.split(",")]
            for file in (place.with_suffix(".py") if place.name else place, place / "__init__.py", *files):
                if file in texts:
                    sources[file] = texts[file]
    return sources


def _writable(folder: Path) -> bool:
    """Whether files can be written there, or the folder be made."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK)


def _temporary_folder() -> Path:
    """A folder for this process and those that it starts. Its name cannot be foreseen: what lies there is run."""
    folder = tempfile.mkdtemp(prefix="bufgym-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = folder
    print(
        "bufgym: compiled code cannot be kept, as neither the package nor the cache folder can be written; "
        "set NUMBA_CACHE_DIR to a folder that can",
        file=sys.stderr,
    )
    return Path(folder)


def _cache_folder() -> str:
    """A folder for machine code that is valid for exactly this state of the package's sources.

    Numba renews a cached kernel when its own file changes but not when a kernel that it calls does. One folder for
    each state of all the sources keeps a stale callee from living on inside its caller.
    """
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if os.environ.get("NUMBA_CACHE_DIR"):
        parent = Path(os.environ["NUMBA_CACHE_DIR"])
    else:
        places = _PACKAGE / "__pycache__", Path(home) / "bufgym"
        parent = next((place for place in places if _writable(place)), None) or _temporary_folder()
    state = hashlib.sha256(b"".join(source for _, source in sorted(_sources().items())))
    folder = parent / f"kernels-{state.hexdigest()[:12]}"
    if not folder.exists():
        # Earlier states are useless, but a running process may still be writing into the latest ones.
        for old in sorted(parent.glob("kernels-*"), key=lambda path: path.stat().st_mtime)[:-8]:
            shutil.rmtree(old, ignore_errors=True)
    return str(folder)


class CodeFiles(caching.IndexDataCacheFile):
    """Machine code on disk: a file for each signature, named by all that it depends on.

    So processes that compile side by side never write into the same one, as Numba's numbered files let them. Damaged
    files are compiled anew; where none can be kept, none is.
    """

    def load(self, key: Any) -> Any:
        """The code compiled for ``key``; None if there is none."""
        try:
            return cast(Any, self)._load_data(self._file(key))
        except Exception:  # a file cut short ends in many kinds of error
            return None

    def save(self, key: Any, data: Any) -> None:
        """Keep the code compiled for ``key``."""
        with contextlib.suppress(OSError):
            cast(Any, self)._save_data(self._file(key), data)

    def _file(self, key: Any) -> str:
        files = cast(Any, self)
        depends_on = repr((files._version, files._source_stamp, key))
        return f"{files._index_name.removesuffix('.nbi')}-{hashlib.sha256(depends_on.encode()).hexdigest()[:16]}.nbc"


FOLDER = _cache_folder() if JIT else ""
"""Where machine code is kept; empty where nothing is compiled."""


class Code(caching.FunctionCache):
    """One kernel's machine code on disk, as it is compiled for its ``role``."""

    def __init__(self, function: Any, role: str) -> None:
        config = cast(Any, numba.config)
        before, config.CACHE_DIR = config.CACHE_DIR, FOLDER or config.CACHE_DIR  # read here only
        try:
            cast(Any, super()).__init__(function)
        finally:
            config.CACHE_DIR = before
        cache = cast(Any, self)
        name, stamp = f"{cache._impl.filename_base}-{role}", cache._impl.locator.get_source_stamp()
        cache._cache_file = cast(Any, CodeFiles)(cache._cache_path, name, stamp)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """What is kept of it; None if nothing is."""
        kept = cast(Any, super()).load_overload(signature, target)
        if kept is None and _ONLY_KEPT.get():
            raise NotKeptError
        return kept


class NotKeptError(Exception):
    """What was asked for must be compiled first."""


_ONLY_KEPT: ContextVar[bool] = ContextVar("only_kept", default=False)


@contextlib.contextmanager
def only_kept() -> Iterator[None]:
    """In this block nothing is compiled: what is not on disk raises a ``NotKeptError``."""
    token = _ONLY_KEPT.set(True)
    try:
        yield
    finally:
        _ONLY_KEPT.reset(token)
