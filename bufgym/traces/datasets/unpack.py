"""Unpack untrusted zip and tar archives: inside their folder, up to a stated size, or not at all.

Only plain files and folders are unpacked. Links, devices, encrypted files, and names that lead out of the folder are
refused. A size that an archive states is checked before a byte is written, and the libraries read no more than it.
"""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import shutil
import stat
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, Final

from bufgym.ground.errors import BufgymError, where
from bufgym.ground.files import unpacked_limit
from bufgym.traces.formats.faults import os_errors

MAX_UNPACKED_BYTES: Final = 2 * 2**30
MAX_MEMBERS: Final = 100_000

# tarfile reads a header of any announced length at once; this is the longest that it may.
_MAX_READ_BYTES = 16 * 2**20
_OPENERS: Final[dict[str, Any]] = {
    ".tar.gz": gzip.open,
    ".tgz": gzip.open,
    ".tar.bz2": bz2.open,
    ".tar.xz": lzma.open,
    ".tar": open,
    ".zip": zipfile.ZipFile,
}
# What the libraries raise on broken archives, found by breaking some.
_DAMAGED = (
    zipfile.BadZipFile,
    tarfile.TarError,
    zlib.error,
    lzma.LZMAError,
    struct.error,
    EOFError,
    OSError,
    RuntimeError,
    LookupError,
    ArithmeticError,
    ValueError,
)


def ending(name: str) -> str | None:
    """The ending that marks a file as an archive, None if it has no such ending."""
    return next((suffix for suffix in _OPENERS if name.lower().endswith(suffix)), None)


def unpack(archive: Path, folder: Path, most_bytes: int = MAX_UNPACKED_BYTES) -> None:
    """Unpack `archive` into `folder`, which must not exist yet; after an error it does not exist either.

    Args:
        archive: named .zip, .tar, .tgz, .tar.gz, .tar.bz2 or .tar.xz.
        folder: created by this call, complete.
        most_bytes: limit of the bytes after decompression; never more than `unpacked_limit` of the archive's size.

    Raises:
        BufgymError: a damaged archive, one that is too big, or a member that must not be in the folder.
    """
    kind = ending(archive.name)
    assert kind is not None
    most_bytes = min(most_bytes, unpacked_limit(archive.stat().st_size))
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    count = total = 0
    try:
        with ExitStack() as stack:
            packed = stack.enter_context(_OPENERS[kind](archive, "r" if kind == ".zip" else "rb"))
            for name, size_bytes, stream in (_zip if kind == ".zip" else _tar)(archive, packed):
                count, total = count + 1, total + size_bytes
                if total > most_bytes or count > MAX_MEMBERS:
                    rule = f"unpacks to more than {most_bytes} bytes or {MAX_MEMBERS} files: must be less"
                    raise BufgymError(where(archive, None, name, rule, field="member"))
                if stream is not None:
                    _copy(stream, _place(archive, unfinished, name))
        if not unfinished.exists():
            raise BufgymError(f"{archive}: holds no file")
        with os_errors(folder, "written"):
            unfinished.rename(folder)
    except BufgymError:
        raise
    except _DAMAGED as error:
        raise BufgymError(f"{archive}: damaged, cut off, or no {kind} archive ({str(error)[:200]})") from None
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


def _place(archive: Path, folder: Path, name: str) -> Path:
    parts = name.split("/")
    if name.startswith("/") or "\\" in name or ":" in name or "\0" in name or {"..", "."} & set(parts) or not name:
        raise BufgymError(where(archive, None, name, "leads out of its folder: must not", field="member"))
    target = folder.joinpath(*parts)
    if target.exists():
        raise BufgymError(where(archive, None, name, "must come only once", field="member"))
    return target


def _copy(stream: IO[bytes], target: Path) -> None:
    with os_errors(target, "written"):
        target.parent.mkdir(parents=True, exist_ok=True)
        out = target.open("xb")
    with out:
        while block := stream.read(2**20):
            with os_errors(target, "written"):
                out.write(block)


def _zip(archive: Path, packed: zipfile.ZipFile) -> Iterator[tuple[str, int, IO[bytes] | None]]:
    """Name, size and content of each member; None for a folder."""
    for info in packed.infolist():
        if info.flag_bits & 1:
            raise BufgymError(where(archive, None, info.filename, "must not be encrypted", field="member"))
        if stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise BufgymError(where(archive, None, info.filename, "must be a plain file", field="member"))
        # Finder's folder of icons and attributes belongs to no data set.
        if info.is_dir() or info.filename.startswith("__MACOSX/"):
            yield info.filename, 0, None
        else:
            with packed.open(info) as stream:
                yield info.filename, info.file_size, stream


def _tar(archive: Path, packed: IO[bytes]) -> Iterator[tuple[str, int, IO[bytes] | None]]:
    """The same of a tar archive."""
    with tarfile.open(fileobj=_Bounded(archive, packed)) as opened:
        for member in opened:
            stream = opened.extractfile(member) if member.isreg() else None
            if stream is None and not member.isdir():
                raise BufgymError(where(archive, None, member.name, "must be a plain file", field="member"))
            yield member.name.removeprefix("./"), member.size, stream


class _Bounded(io.RawIOBase):
    """The decompressed bytes of a tar file, a limited number at once."""

    def __init__(self, archive: Path, inner: IO[bytes]) -> None:
        self._archive, self._inner = archive, inner
        self.seek, self.tell = inner.seek, inner.tell  # type: ignore[method-assign]

    def read(self, size: int = -1) -> bytes:
        if size > _MAX_READ_BYTES:
            raise BufgymError(f"{self._archive}: a header of {size} bytes: must be at most {_MAX_READ_BYTES}")
        return self._inner.read(size)
