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

from numba.core import compiler, serialize

from bufgym.ground.files import PACKAGE, replaced
from bufgym.ground.kernel.arrays import JIT
from bufgym.ground.kernel.closure import TOOLS, closure, told_types
from bufgym.ground.kernel.pipeline import PART, PartLibrary, set_environments


def _writable(folder: Path) -> bool:
    """Whether files can be written in ``folder``, which is made if missing."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    return folder.is_dir() and os.access(folder, os.W_OK)


def _temporary_folder() -> Path:
    """Make a folder for this process and its children. Its name cannot be foreseen, as its content is executed."""
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
    """Choose the folder for machine code: ``NUMBA_CACHE_DIR``, beside the package, or in the user's cache."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    if os.environ.get("NUMBA_CACHE_DIR"):
        parent = Path(os.environ["NUMBA_CACHE_DIR"])
    else:
        places = PACKAGE / "__pycache__", Path(home) / "bufgym"
        parent = next((place for place in places if _writable(place)), None) or _temporary_folder()
    return str(parent / "kernels")


FOLDER = _cache_folder() if JIT else ""
"""Folder for machine code; empty if nothing is compiled."""

_KEPT_VERSIONS = 16  # most files of one kernel: one for each set of argument types and each state of its sources


class Code:
    """Machine code of one kernel on disk, a file for each set of argument types.

    A file is named by everything that its code depends on (see ``closure``). So processes that compile side by side
    never write different code into one file, and code of an earlier source is never found. A damaged file is compiled
    anew. If no file can be written, nothing is stored.
    """

    def __init__(self, function: Any, role: str) -> None:
        self._function, self._role = function, role
        self._closure = ""
        name = f"{function.__module__}.{function.__qualname__}-{role}"
        self._name = "".join(letter if letter.isalnum() or letter in "._-" else "_" for letter in name)[-150:]

    def load_overload(self, signature: Any, target: Any) -> Any:
        """Code compiled for the types of ``signature``, or None if there is none."""
        target.refresh()
        try:
            kept = pickle.loads(self._file(signature, target.codegen()).read_bytes())
            return _rebuilt(target, kept)
        except Exception:  # a file that is missing, or cut short, which ends in many kinds of error
            if _ONLY_KEPT.get():
                raise NotKeptError from None
            return None

    def save_overload(self, signature: Any, result: Any) -> None:
        """Store the code that was compiled for the types of ``signature``."""
        if not isinstance(result.library, PartLibrary):
            set_environments(result)
        if result.lifted or result.library.has_dynamic_globals:  # it holds addresses of this process
            return
        file = self._file(signature, result.codegen)
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            with replaced(file) as part:
                part.write_bytes(cast(Any, serialize).dumps(result._reduce()))
            versions = sorted(file.parent.glob(f"{self._name}-*.nbc"), key=lambda path: path.stat().st_mtime)
            for old in versions[:-_KEPT_VERSIONS]:
                old.unlink(missing_ok=True)

    def _file(self, signature: Any, generator: Any) -> Path:
        if not self._closure:  # now, as the module's later functions did not exist when it was decorated
            self._closure = closure(self._function)
        depends_on = repr((TOOLS, self._closure, told_types(signature), generator.magic_tuple()))
        return Path(FOLDER, f"{self._name}-{hashlib.sha256(depends_on.encode()).hexdigest()[:20]}.nbc")


_REDUCED = ("fndesc", "environment", "signature", "objectmode", "lifted", "type_annotation", "reload_init")
"""What ``CompileResult._reduce`` gives after the library and before the environments of other functions."""


def _rebuilt(target: Any, kept: tuple[Any, ...]) -> Any:
    """Rebuild a compile result from ``kept``, the output of ``CompileResult._reduce``."""
    library, *parts, environments = kept
    found = dict(zip(_REDUCED, parts, strict=True))
    for function in found["reload_init"]:
        function()
    code = PartLibrary.read(target, library) if library[1] == PART else target.codegen().unserialize_library(library)
    found["entry_point"] = target.get_executable(code, found["fndesc"], found["environment"])
    for known in environments:
        code.codegen.set_env(known.env_name, known)
    found |= {"target_context": target, "typing_context": target.typing_context, "library": code}
    return cast(Any, compiler).compile_result(**found, referenced_envs=environments)


class NotKeptError(Exception):
    """The requested code must be compiled first."""


_ONLY_KEPT: ContextVar[bool] = ContextVar("only_kept", default=False)


@contextlib.contextmanager
def only_kept() -> Iterator[None]:
    """Compile nothing in this block: code that is not on disk raises a ``NotKeptError``."""
    token = _ONLY_KEPT.set(True)
    try:
        yield
    finally:
        _ONLY_KEPT.reset(token)
