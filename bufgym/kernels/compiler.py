"""The C compiler: which one is here, and how it makes one shared library of many files.

No flag changes a result: a kernel computes the same numbers with every compiler, on every processor of the platform.
``-ffp-contract=off`` keeps a product and a sum apart, which a fused multiply-add would round once. Calls of libm stay
calls, where compilers would write ``x * x`` for ``pow(x, 2)`` or work ``exp`` of a constant out by themselves.
"""

import functools
import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from bufgym.utils.errors import BufgymError, unknown, where
from bufgym.utils.files import replaced

_NAMES: Final = ("cc", "gcc", "clang")
_LIBM: Final = (
    *("exp", "exp2", "expm1", "lgamma", "log", "log10", "log1p", "log2", "pow", "tanh"),
    *("sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "hypot"),
)
"""Functions whose result may differ between libraries in the last bit."""
_FLAGS: Final = (
    *("-std=c11", "-O3", "-w", "-fwrapv", "-fno-semantic-interposition"),
    *("-ffp-contract=off", "-fno-math-errno", *(f"-fno-builtin-{name}" for name in _LIBM)),
)
_ERRORS: Final = 3
"""Most lines of a compiler's errors that a message repeats."""
_PATIENCE_S: Final = 60.0
"""A compiler says by then what it is."""
HINT: Final = "install a C compiler (apt-get install gcc libc6-dev) or the one on PyPI (pip install ziglang)"


@dataclass(frozen=True)
class Target:
    """A platform that zig compiles for on any machine."""

    triple: str
    """Its name for zig, with the oldest system on which the library runs."""
    tag: str
    """Its name in a wheel's file name."""
    suffix: str


TARGETS: Final = {
    "x86_64-linux": Target("x86_64-linux-gnu.2.17", "manylinux_2_17_x86_64", ".so"),
    "aarch64-linux": Target("aarch64-linux-gnu.2.17", "manylinux_2_17_aarch64", ".so"),
    # Nobody has run these.
    "macos-arm64": Target("aarch64-macos.11.0", "macosx_11_0_arm64", ".dylib"),
    "macos-x86_64": Target("x86_64-macos.11.0", "macosx_11_0_x86_64", ".dylib"),
    "windows-x86_64": Target("x86_64-windows-gnu", "win_amd64", ".dll"),
}
"""Name, as in the environment variable BUFGYM_TARGET -> platform."""


def chosen(target: str) -> Target:
    """The platform of that name; BufgymError for any other."""
    if target not in TARGETS:
        raise unknown("target", target, TARGETS, place="BUFGYM_TARGET")
    return TARGETS[target]


def library_suffix(target: str | None = None) -> str:
    """How the name of a shared library ends on that platform; None is this one."""
    if target is not None:
        return chosen(target).suffix
    return {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")


class _FailedError(Exception):
    """A program that is not there, or ends with an error; says why in a few words."""


@dataclass(frozen=True)
class Compiler:
    """A C compiler that understands the arguments of gcc."""

    command: list[str]
    """The program, and arguments that come before all others."""
    version: str
    """The first line that it says about itself."""
    machine: str
    """What it compiles for."""
    is_zig: bool = False

    @property
    def identity(self) -> str:
        """What decides which code it makes of the same file: its name, version, machine and flags."""
        return "; ".join([shlex.join(self.command), self.version, self.machine, shlex.join(self._flags(None))])

    def compile(
        self, sources: Sequence[Path], library: Path, *, flags: Sequence[str] = (), target: str | None = None
    ) -> None:
        """Compile the files side by side and link them to one shared library, written whole or not at all.

        Args:
            sources: files of C.
            library: the file to write.
            flags: arguments beside the usual ones and those of the environment variable BUFGYM_CFLAGS.
            target: a name of TARGETS, for zig; None is this machine.

        Raises BufgymError: the first errors that the compiler found.
        """
        from concurrent.futures import ThreadPoolExecutor  # imports logging; most processes compile nothing

        usual = [*self._flags(target), *flags]
        # Linked to a name of its own: macOS and Windows write the name into the file.
        with tempfile.TemporaryDirectory(prefix="bufgym-cc-") as name, ThreadPoolExecutor(_workers()) as pool:
            folder = Path(name)

            def translate(number: int) -> None:
                arguments = [*usual, "-c", "-o", f"{number}.o", str(sources[number].absolute())]
                self._run(arguments, folder, sources[number].name)

            # The longest file first: it would be the last to end.
            order = sorted(range(len(sources)), key=lambda number: -sources[number].stat().st_size)
            running = [pool.submit(translate, number) for number in order]
            try:
                for future in running:
                    future.result()
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
            objects = [f"{number}.o" for number in range(len(sources))]
            libm = [] if library_suffix(target) == ".dll" else ["-lm"]
            self._run([*usual, "-shared", "-o", library.name, *objects, *libm], folder, library.name)
            with replaced(library) as temporary:
                shutil.copyfile(folder / library.name, temporary)

    def _flags(self, target: str | None) -> list[str]:
        """The arguments of every call."""
        flags = [*_FLAGS, *([] if library_suffix(target) == ".dll" else ["-fPIC"])]
        if self.is_zig:
            # zig would compile for the very processor of this machine, trap what C leaves undefined, and name folders.
            flags += ["-mcpu=baseline", "-fno-sanitize=undefined", "-g0", "-fomit-frame-pointer"]
        if target is not None:
            if not self.is_zig:
                raise BufgymError(where("BUFGYM_TARGET", None, target, "only zig compiles for other platforms"))
            flags += ["-target", chosen(target).triple]
        extra = os.environ.get("BUFGYM_CFLAGS", "")
        try:
            return flags + shlex.split(extra)
        except ValueError as error:
            raise BufgymError(where("BUFGYM_CFLAGS", None, extra, str(error))) from None

    def _run(self, arguments: list[str], folder: Path, what: str) -> None:
        """Call the compiler in a temporary folder, about the file ``what``."""
        try:
            _output([*self.command, *arguments], folder)
        except _FailedError as error:
            raise BufgymError(f"{what}: {Path(self.command[0]).name} failed: {error}") from None


def _workers() -> int:
    """How many processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _output(command: list[str], folder: Path, *, given: str = "", timeout_s: float | None = None) -> str:
    """What a compiler prints; ``folder`` is its own, and holds zig's cache where the user's cannot be written."""
    # In English, where "error" is an error.
    environment = {**os.environ, "LC_ALL": "C"}
    if not _caches():
        environment.setdefault("ZIG_GLOBAL_CACHE_DIR", str(folder / "zig"))
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=environment,
            input=given,
            capture_output=True,
            encoding="utf-8",
            errors="replace",
            timeout=timeout_s,
            check=False,
        )
    except OSError as error:
        raise _FailedError(error.strerror or str(error)) from None
    except subprocess.TimeoutExpired:
        raise _FailedError(f"no answer within {timeout_s:g} s") from None
    if done.returncode == 0:
        return done.stdout
    lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    told = [line for line in lines if "error" in line.lower()] or lines or [f"exit code {done.returncode}"]
    raise _FailedError(" / ".join(told[:_ERRORS]))


def _caches() -> bool:
    """Whether zig can write its cache where it usually does."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.environ.get("HOME") or os.path.expanduser("~"), ".cache")
    folder = Path(base, "zig")
    there = next((place for place in (folder, *folder.parents) if place.exists()), folder)
    return os.access(there, os.W_OK)


def _asked(command: list[str]) -> Compiler:
    """The compiler of that command, which has said what it is and found the headers of libc."""
    program = shutil.which(command[0])
    if program is None:
        raise _FailedError("no such program")
    words = [os.path.abspath(program), *command[1:]]
    is_zig = not {"zig", "ziglang"}.isdisjoint(Path(word).stem for word in words)
    with tempfile.TemporaryDirectory(prefix="bufgym-cc-") as name:

        def ask(*arguments: str, given: str = "") -> str:
            return _output([*words, *arguments], Path(name), given=given, timeout_s=_PATIENCE_S)

        version, machine = ask("--version"), ask("-dumpmachine").strip()
        # Debian's gcc comes without them.
        ask("-E", "-x", "c", "-", given="#include <math.h>\n")
        if is_zig and "cc" in words:  # whose version is that of its clang
            version = f"zig {_output([*words[: words.index('cc')], 'version'], Path(name), timeout_s=_PATIENCE_S)}"
    return Compiler(words, version.partition("\n")[0].strip(), machine, is_zig)


@functools.cache
def find() -> Compiler | None:
    """The compiler of the environment variable CC, else cc, gcc or clang, else zig of the wheel ziglang, else None.

    Raises BufgymError: CC names none that works.
    """
    if given := os.environ.get("CC", "").strip():
        try:
            return _asked(shlex.split(given))
        except (_FailedError, ValueError) as error:
            raise BufgymError(where("CC", None, given, f"must be a C compiler: {error}")) from None
    return on_path() or zig()


@functools.cache
def on_path() -> Compiler | None:
    """The first of cc, gcc and clang that works."""
    for name in _NAMES:
        try:
            return _asked([name])
        except _FailedError:
            continue
    return None


@functools.cache
def zig() -> Compiler | None:
    """The compiler of the wheel ziglang, where it is installed."""
    if importlib.util.find_spec("ziglang") is None:
        return None
    try:
        return _asked([sys.executable, "-m", "ziglang", "cc"])
    except _FailedError as error:
        raise BufgymError(f"ziglang is installed, and does not work: {error}") from None
