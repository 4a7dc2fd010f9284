"""Hatchling's hook: kernels become C, and one shared library, when a wheel or an editable installation is built.

A wheel carries the library in ``bufgym/kernels/built``; an editable installation has it there in the source tree.

Environment variables:
    CC: the C compiler, with arguments. Without one on this machine, the build asks pip for zig (the wheel ziglang).
    BUFGYM_CFLAGS: more arguments of the compiler.
    BUFGYM_TARGET: another platform, which zig compiles for: a name of ``bufgym.kernels.compiler.TARGETS``.
    BUFGYM_NO_KERNELS: 1 builds a wheel without the library.
"""

import os
import shutil
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.config import BuilderConfig
from hatchling.builders.hooks.plugin.interface import BuildHookInterface

BUILT = "bufgym/kernels/built"
NAME = "bufgym_kernels"
ZIG = "ziglang>=0.13"
WITHOUT = "BUFGYM_NO_KERNELS=1 builds without them"


class KernelsHook(BuildHookInterface[BuilderConfig]):
    """Translates and compiles the kernels."""

    _folder: tempfile.TemporaryDirectory[str] | None = None
    """Where a wheel's library waits for being packed."""

    def dependencies(self) -> list[str]:
        """Zig, where it is the only compiler, or the only one for that platform."""
        if _without_kernels():
            return []
        compiler = self._compiler()
        return [ZIG] if _target() or not (os.environ.get("CC") or compiler.on_path()) else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build the library, and have it packed."""
        if _without_kernels():
            return
        build_data["pure_python"] = False
        if version == "editable":
            self._build(Path(self.root, BUILT), None)
            return
        target = _target()
        # Packed after this returns; gone with this object, whether or not the build succeeds.
        self._folder = tempfile.TemporaryDirectory(prefix="bufgym-kernels-")
        for file in self._build(Path(self._folder.name), target):
            build_data["force_include"][str(file)] = f"{BUILT}/{file.name}"
        platform = self._compiler().chosen(target).tag if target else _this_platform()
        build_data["tag"] = f"py3-none-{platform}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Clear up."""
        if self._folder:
            self._folder.cleanup()

    def _compiler(self) -> Any:
        """The module of compilers in this source tree."""
        if self.root not in sys.path:
            sys.path.insert(0, self.root)
        from bufgym.kernels import compiler

        return compiler

    def _build(self, folder: Path, target: str | None) -> list[Path]:
        """Compile all kernels; return the library and its list of entries, which lie in ``folder``."""
        compiler = self._compiler()
        from bufgym import build
        from bufgym.utils.errors import BufgymError

        try:
            found = compiler.zig() if target else compiler.find()
            if found is None:
                raise BufgymError(f"bufgym's kernels are compiled C: {_needed(target) or compiler.HINT}; {WITHOUT}")
            folder.mkdir(parents=True, exist_ok=True)
            library = folder / f"{NAME}{compiler.library_suffix(target)}"
            with tempfile.TemporaryDirectory(prefix="bufgym-c-") as name:
                found.compile(build.sources(Path(name)), library, target=target)
                entries = Path(shutil.copy(Path(name, "entries.json"), folder))
        except BufgymError as error:
            raise SystemExit(f"error: {error}") from None  # in one line
        return [library, entries]


def _needed(target: str | None) -> str:
    """What a platform needs that is not this one."""
    return f"those for {target} need zig: pip install ziglang" if target else ""


def _target() -> str | None:
    """The other platform that is asked for."""
    return os.environ.get("BUFGYM_TARGET") or None


def _without_kernels() -> bool:
    """Whether the library is not wanted."""
    return os.environ.get("BUFGYM_NO_KERNELS", "0") not in ("", "0")


def _this_platform() -> str:
    """This machine in a wheel's file name, such as linux_x86_64."""
    return sysconfig.get_platform().replace("-", "_").replace(".", "_")
