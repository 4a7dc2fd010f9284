"""The one decorator for compiled functions.

A *kernel* is a plain Python function over arrays that the caller owns. Numba compiles it on its first call and keeps
the machine code on disk; with ``NUMBA_DISABLE_JIT=1`` the same source runs as ordinary Python, which is how the tests
check the compiled code against its own text.
"""

from __future__ import annotations

import atexit
import contextlib
import hashlib
import os
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numba.extending
import numpy as np
from numba.core import caching, event
from numpy.typing import NDArray

Function = TypeVar("Function", bound=Callable[..., Any])
Result = TypeVar("Result")

JIT = not cast(Any, numba.config).DISABLE_JIT
"""False where compilation is off and every kernel runs as its Python source."""

# Arithmetic follows IEEE 754 to the letter (no fast maths): single = batch and compiled = uncompiled, bit for bit.
# Kernels work on arrays that their caller holds, so reference counting (_nrt) is off and one kernel is inlined into the
# next: together that is five times faster. In return a kernel must neither allocate nor return an array to Python.
_OPTIONS = {"nogil": True, "error_model": "numpy", "_nrt": False, "forceinline": True}

_PACKAGE = Path(__file__).resolve().parent


def _sources() -> dict[Path, bytes]:
    """Every source that compiled code rests on: those with kernels, and the modules whose names they import."""
    texts = {path.relative_to(_PACKAGE): path.read_bytes() for path in sorted(_PACKAGE.rglob("*.py"))}
    sources = {path: text for path, text in texts.items() if b"bufgym.kernel import" in text}
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


class _CodeFiles(caching.IndexDataCacheFile):
    """Numba's files of one kernel's machine code. Damaged ones are compiled anew; where none can be kept, none is."""

    def load(self, key: Any) -> Any:
        """The code compiled for ``key``; None if there is none."""
        try:
            return cast(Any, super()).load(key)
        except Exception:  # a file cut short ends in many kinds of error
            return None

    def save(self, key: Any, data: Any) -> None:
        """Keep the code compiled for ``key``."""
        with contextlib.suppress(OSError):
            cast(Any, super()).save(key, data)

    def _load_index(self) -> Any:
        try:
            return cast(Any, super())._load_index()
        except Exception:
            return {}


FOLDER = _cache_folder() if JIT else ""
"""Where machine code is kept; empty where nothing is compiled."""


# --- a word while it takes long --------------------------------------------------------------------------------------

PATIENCE_S = 1.0
"""Compiling that takes longer is announced."""
NOTICE = "bufgym: compiling, once (about 30 s; bufgym warmup does it beforehand)"


class _Announcer(event.Listener):
    """Writes ``NOTICE`` to stderr, once, when compiling has taken a process ``PATIENCE_S`` in all.

    Numba tells of a kernel that it compiles, and of those that are compiled on the way; of one from the cache it
    tells nothing.
    """

    def __init__(self) -> None:
        self.done = False
        self._depth, self._spent_s, self._began_s = 0, 0.0, 0.0
        self._timer: threading.Timer | None = None

    def on_start(self, compiling: Any) -> None:
        if not _is_ours(compiling):
            return
        self._depth += 1
        if self._depth == 1 and not self.done:
            self._began_s = time.perf_counter()
            self._timer = threading.Timer(max(0.0, PATIENCE_S - self._spent_s), self._say)
            self._timer.daemon = True
            self._timer.start()

    def on_end(self, compiling: Any) -> None:
        if not _is_ours(compiling):
            return
        self._depth -= 1
        if self._depth == 0 and self._timer is not None:
            self._timer.cancel()
            self._timer = None
            self._spent_s += time.perf_counter() - self._began_s

    def _say(self) -> None:
        if not self.done and sys.stderr is not None:
            print(NOTICE, file=sys.stderr, flush=True)
        self.done = True


def _is_ours(compiling: Any) -> bool:
    return str(compiling.data["dispatcher"].py_func.__module__).split(".")[0] == "bufgym"


_announcer = _Announcer()
cast(Any, event).register("numba:compile", _announcer)


def compile_silently() -> None:
    """This process says nothing of compiling from now on."""
    _announcer.done = True


# --- the decorator ---------------------------------------------------------------------------------------------------


def _compile(function: Callable[..., Any], *signature: Any) -> Any:
    # Numba reads the folder and makes the files' object when the decorator runs; other packages' stay as they were.
    config, njit, module = cast(Any, numba.config), cast(Any, numba.njit), cast(Any, caching)
    before = config.CACHE_DIR, module.IndexDataCacheFile
    config.CACHE_DIR, module.IndexDataCacheFile = FOLDER or config.CACHE_DIR, _CodeFiles
    try:
        return njit(*signature, cache=True, **_OPTIONS)(function)
    finally:
        config.CACHE_DIR, module.IndexDataCacheFile = before


def kernel(function: Function) -> Function:
    """Compile ``function`` on its first call, for the types that it is called with."""
    return cast(Function, _compile(function))


def compile_for(signature: Any, function: Function) -> Function:
    """Compile ``function`` now for exactly ``signature``, so that it can be passed to other kernels as a value.

    Functions of one signature share one type: the kernel that receives them is compiled once and serves them all.
    """
    if not JIT:
        return function
    return cast(Function, _compile(function, signature))


def interruptible(work: Callable[[], Result]) -> Result:
    """``work()``, which may spend minutes in kernels, while Ctrl-C is answered at once.

    Python heeds a signal only in its main thread, and there only between two of its own instructions: so that thread
    waits while another works (60 us). After a KeyboardInterrupt that one goes on until its kernel ends or the process.
    """
    if threading.current_thread() is not threading.main_thread():
        return work()
    future: Future[Result] = Future()

    def carry_out() -> None:
        try:
            future.set_result(work())
        except BaseException as error:  # it belongs to the thread that waits
            future.set_exception(error)

    threading.Thread(target=carry_out, daemon=True).start()
    while not future.done():
        wait([future], 0.5)  # where a signal does not end a wait (Windows), half a second does
    return future.result()


def records(shape: int | tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Zeroed records whose fields read as attributes (``a[i].field``) in kernels, compiled or not."""
    zeros = np.zeros(shape, dtype)
    return zeros if JIT else zeros.view(np.recarray)


# What follows works on elements that exist: indices are >= 0 and slices lie inside the array. Numba's own
# indexing checks the sign of every index and the ends of every slice, which is a fifth of a rollout's instructions.


def item(array: NDArray[Any], k: int) -> Any:
    """``array[k]``."""
    return array[k]


def at(array: NDArray[Any], i: int, k: int) -> Any:
    """``array[i, k]``."""
    return array[i, k]


def stretch(array: NDArray[Any], i: int, first: int, length: int) -> Any:
    """``array[i, first : first + length]`` of an array in C order."""
    return array[i, first : first + length]


def table(array: NDArray[Any], i: int, first: int, rows: int, columns: int) -> Any:
    """``array[i, first : first + rows * columns]`` as rows x columns, of an array in C order."""
    return array[i, first : first + rows * columns].reshape(rows, columns)


def prefetch(array: NDArray[Any], i: int, k: int) -> None:
    """Ask the processor to fetch ``array[i, k]`` into its cache, without waiting for it; nothing in plain Python."""


def _place(context: Any, builder: Any, signature: Any, arguments: Any, indices: Any) -> Any:
    """LLVM's pointer to the element of the first argument, an array, at ``indices``."""
    from numba.core import cgutils

    kind = signature.args[0]
    view = context.make_array(kind)(context, builder, arguments[0])
    return cast(Any, cgutils).get_item_pointer(context, builder, kind, view, list(indices), wraparound=False)


def _read(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """LLVM's code of ``item`` and ``at``."""
    from numba.np import arrayobj

    place = _place(context, builder, signature, arguments, arguments[1:])
    return cast(Any, arrayobj).load_item(context, builder, signature.args[0], place)


def _view(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """LLVM's code of ``stretch``."""
    from numba.np import arrayobj

    whole = context.make_array(signature.args[0])(context, builder, arguments[0])
    place = _place(context, builder, signature, arguments, arguments[1:3])
    view = context.make_array(signature.return_type)(context, builder)
    size, shape = whole.itemsize, [arguments[3]]
    cast(Any, arrayobj).populate_array(view, place, shape, [size], size, whole.meminfo, whole.parent)
    return view._getvalue()


def _table(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """LLVM's code of ``table``."""
    from numba.np import arrayobj

    whole = context.make_array(signature.args[0])(context, builder, arguments[0])
    place = _place(context, builder, signature, arguments, arguments[1:3])
    view = context.make_array(signature.return_type)(context, builder)
    size, shape = whole.itemsize, list(arguments[3:5])
    steps = [builder.mul(shape[1], size), size]
    cast(Any, arrayobj).populate_array(view, place, shape, steps, size, whole.meminfo, whole.parent)
    return view._getvalue()


def _hint(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    """LLVM's code of ``prefetch``."""
    from llvmlite import ir
    from numba.core import cgutils

    place = _place(context, builder, signature, arguments, arguments[1:])
    number, byte = ir.IntType(32), ir.IntType(8).as_pointer()
    hint = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
    function = cast(Any, cgutils).get_or_insert_function(builder.module, hint, "llvm.prefetch.p0")
    # 1: it will be written; 3: keep it near; 1: data, not code
    builder.call(function, [builder.bitcast(place, byte), number(1), number(3), number(1)])
    return context.get_dummy_value()


def _compile_as(function: Callable[..., Any], typer: Callable[..., Any], code: Callable[..., Any]) -> None:
    """Numba compiles calls of ``function`` to ``code``; ``typer`` gives the type of the result."""
    numba_ = cast(Any, numba)
    numba_.extending.type_callable(function)(lambda context: typer)
    numba_.extending.lower_builtin(function, numba_.types.Array, numba_.types.VarArg(numba_.types.Any))(code)


_compile_as(item, lambda array, k: array.dtype, _read)
_compile_as(at, lambda array, i, k: array.dtype, _read)
_compile_as(stretch, lambda array, i, first, length: array.copy(ndim=1), _view)
_compile_as(table, lambda array, i, first, rows, columns: array.copy(ndim=2), _table)
_compile_as(prefetch, lambda array, i, k: numba.types.void, _hint)
