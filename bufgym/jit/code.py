"""Compiled code of kernels: the library that comes with the package, else one of the kernel's own, made once.

The package's library was built from its sources. Each of its kernels is used while all that it depends on is as it was
then. Anything else is translated, compiled, and kept in the ``FOLDER`` under a name that says what it was made from.
"""

import contextlib
import ctypes
import functools
import hashlib
import json
import linecache
import os
import re
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bufgym.jit.call import say_once
from bufgym.jit.fingerprint import fingerprint
from bufgym.jit.folder import FOLDER
from bufgym.jit.values import NotNumbersError, read, spelled, struct_of, value_of, words
from bufgym.jit.way import CHECKED, WAY
from bufgym.kernels.compiler import HINT, find, library_suffix
from bufgym.kernels.kinds import Given, Kind, Number, Pointer, Tuple
from bufgym.utils.files import PACKAGE, replaced

BUILT = PACKAGE / "kernels" / "built"
"""Folder of the library that comes with the package, and of ``entries.json``."""
KEPT = 16  # files of one kernel: one for each set of kinds of its arguments and each state of its sources
_LOCK = threading.RLock()

noted: list[tuple[Any, Any]] | None = None
"""Where it is a list, kernels run as Python, and each that is asked for is noted here: (function, its kinds)."""


@dataclass(frozen=True)
class Code:
    """A kernel's entry from Python, for arguments of these ``kinds``."""

    run: Callable[[int], bytes | None]
    kinds: tuple[Kind, ...]
    result: Kind

    @functools.cached_property
    def struct(self) -> Any:
        """The struct of its arguments and its result."""
        return struct_of(self.kinds, False, self.result)

    @functools.cached_property
    def gives_number(self) -> bool:
        """Whether its result is a number, which the struct has as Python does."""
        return isinstance(self.result, Number)

    def words(self, arguments: tuple[Any, ...]) -> tuple[Any, list[Any], list[Any]]:
        """(The struct of the arguments, what it points to, (copy, array) of arrays that were copied)."""
        kept: list[Any] = []
        made = self.struct(*words(self.kinds, arguments, kept))
        return made, kept, [pair for pair in kept if isinstance(pair, tuple)]

    def value_of(self, found: Any) -> Any:
        """The result in C as a value of Python."""
        return value_of(self.result, found)


def name_of(function: Any, kinds: Any) -> str:
    """What tells a kernel for these kinds, or for a pointer's, from all others, but for its source."""
    kinds = (kinds,) if isinstance(kinds, Pointer) else kinds
    return f"{_place(function)}({', '.join(map(_described, kinds))})"


def _place(function: Any) -> str:
    file = function.__code__.co_filename
    return f"{file if file.startswith('<') else function.__module__}.{function.__qualname__}"


def _described(kind: Kind) -> str:
    if isinstance(kind, Tuple):
        inside = ", ".join(map(_described, kind.items))
        return f"{kind.title}[{' '.join(kind.names)}]({inside})"
    if isinstance(kind, Pointer):
        return f"function({', '.join(map(_described, kind.arguments))}: {kind.result})"
    return _place(kind.function) if isinstance(kind, Given) else str(kind)


def symbol_of(function: Any, kinds: Any) -> str:
    """Its name in C."""
    name = name_of(function, kinds)
    short = re.sub(r"\W+", "_", name.partition("(")[0].rpartition(".")[2])
    return f"bufgym_{short.strip('_')}_{hashlib.sha256(name.encode()).hexdigest()[:12]}"


def state_of(function: Any, kinds: Any) -> str:
    """Hash of all that the kernel's C depends on."""
    return hashlib.sha256("".join(fingerprint(f) for f in (function, *_given(kinds))).encode()).hexdigest()[:20]


def _given(kinds: Any) -> list[Any]:
    """Functions that become part of the code."""
    kinds = kinds.arguments if isinstance(kinds, Pointer) else kinds
    inner = [f for kind in kinds if isinstance(kind, Tuple) for f in _given(kind.items)]
    return [*(kind.function for kind in kinds if isinstance(kind, Given)), *inner]


def entry(function: Any, kinds: tuple[Kind, ...], ready: bool = False) -> Code | None:
    """The code that Python calls; None where there is no compiler, or where it must be ``ready`` and is not."""
    if _noted(function, kinds):
        return None
    symbol = symbol_of(function, kinds)
    try:
        library = _library(function, kinds, symbol, ready)
    except NotNumbersError:
        return None
    if library is None:
        return None
    run = getattr(library, symbol)
    run.argtypes, run.restype = [ctypes.c_void_p], ctypes.c_char_p
    gives = ctypes.c_char_p.in_dll(library, f"{symbol}_gives").value or b""
    return Code(run, kinds, read(gives.decode()))


def address(function: Any, pointer: Pointer) -> int | None:
    """The address of a kernel that others call through a pointer of this kind; None where there is no compiler."""
    if _noted(function, pointer):
        return None
    symbol = symbol_of(function, pointer)
    library = _library(function, pointer, symbol, False)
    return None if library is None else ctypes.cast(getattr(library, symbol), ctypes.c_void_p).value


def _noted(function: Any, kinds: Any) -> bool:
    if noted is not None and (function, kinds) not in noted:
        noted.append((function, kinds))
    return noted is not None


def add(program: Any, function: Any, kinds: Any, symbol: str) -> None:
    """Add to a program what Python calls, or, for the kind of a pointer, what kernels call through it."""
    if isinstance(kinds, Pointer):
        program.hook(symbol, function, kinds)
    else:
        result = program.entry(symbol, function, kinds)
        program.text(f'BG_EXPORT const char *{symbol}_gives = "{spelled(result)}";')


# ---------------------------------------------------------------- where it is


@functools.cache
def sources() -> str:
    """Hash of the package's sources."""
    files = sorted(file for file in PACKAGE.rglob("*") if file.suffix in (".py", ".h"))
    return hashlib.sha256(b"".join(hashlib.sha256(file.read_bytes()).digest() for file in files)).hexdigest()


@functools.cache
def translator() -> str:
    """Hash of what makes C of a kernel."""
    folders = (PACKAGE / "kernels", PACKAGE / "jit")
    files = sorted(file for folder in folders for file in folder.glob("*") if file.suffix in (".py", ".h"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:20]


@functools.cache
def built() -> tuple[Any, dict[str, str], bool, bool]:
    """(The package's library, symbol -> state, whether all sources are as they were, whether states compare).

    States are of Python's code, which each version of Python writes in a way of its own.
    """
    try:
        listed = json.loads((BUILT / "entries.json").read_text(encoding="utf-8"))
        same = listed["sources"] == sources()
        compares = listed["python"] == sys.implementation.cache_tag and listed["translator"] == translator()
        if WAY == CHECKED or os.environ.get("BUFGYM_CFLAGS") or not (same or compares):  # C of another kind is wanted
            return None, {}, False, False
        return ctypes.CDLL(str(BUILT / f"bufgym_kernels{library_suffix()}")), listed["states"], same, compares
    except (OSError, ValueError, KeyError):
        return None, {}, False, False


def _library(function: Any, kinds: Any, symbol: str, ready: bool) -> Any:
    """The library that has a kernel; None where it could not be made, or is not ``ready``."""
    library, states, same, compares = built()
    own = all(map(is_own, (function, *_given(kinds))))
    if symbol in states and ((same and own) or (compares and states[symbol] == state_of(function, kinds))):
        return library
    with _LOCK:
        return _made(function, kinds, symbol, ready)


def is_own(function: Any) -> bool:
    """Whether a function stands in a file of the package and is the only one of its name."""
    code = function.__code__
    return function.__module__.partition(".")[0] == "bufgym" and not function.__closure__ and code.co_filename[0] != "<"


def _made(function: Any, kinds: Any, symbol: str, ready: bool) -> Any:
    """A library of the kernel alone, from the folder of cached code, or made now."""
    compiler = find()
    if compiler is None:
        if ready:
            return None
        say_once(f"no C compiler: {function.__qualname__} runs as plain Python, much slower; {HINT}")
        return None
    depends = repr((state_of(function, kinds), symbol, translator(), sys.implementation.cache_tag,
                    compiler.identity, _lines(function) if WAY == CHECKED else ""))  # fmt: skip
    file = Path(FOLDER, f"{symbol}-{hashlib.sha256(depends.encode()).hexdigest()[:20]}{library_suffix()}")
    if _is_whole(file):
        return ctypes.CDLL(str(file))
    return None if ready else _compiled(function, kinds, symbol, file, compiler)


def _lines(function: Any) -> str:
    """What decides the lines that a checked kernel names."""
    file = function.__code__.co_filename
    text = "".join(linecache.getlines(file, function.__globals__))
    return "".join((sources(), file, hashlib.sha256(text.encode()).hexdigest()))


def _is_whole(file: Path) -> bool:
    """Whether the file is there as it was written: to load a part of one would end the process."""
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest() == file.with_suffix(".sum").read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        return False


def _compiled(function: Any, kinds: Any, symbol: str, file: Path, compiler: Any) -> Any:
    """Compile a kernel, load it, and keep its library where that can be."""
    from bufgym.kernels.program import Program

    program = Program(checked=WAY == CHECKED)
    add(program, function, kinds, symbol)
    with tempfile.TemporaryDirectory(prefix="bufgym-") as folder:
        source, made = Path(folder, f"{symbol}.c"), Path(folder, file.name)
        source.write_text(program.source(), encoding="utf-8")
        compiler.compile([source], made)
        with contextlib.suppress(OSError):  # a full disk keeps nothing
            file.parent.mkdir(parents=True, exist_ok=True)
            with replaced(file) as part:
                shutil.copyfile(made, part)
            with replaced(file.with_suffix(".sum")) as part:
                part.write_text(hashlib.sha256(made.read_bytes()).hexdigest(), encoding="ascii")
            others = sorted(file.parent.glob(f"{symbol}-*"), key=lambda path: path.stat().st_mtime)
            for old in others[: -2 * KEPT]:
                old.unlink(missing_ok=True)
        return ctypes.CDLL(str(made))
