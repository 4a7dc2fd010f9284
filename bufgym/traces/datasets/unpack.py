"""Unpack untrusted zip and tar archives: inside their folder, up to a stated size, or not at all.

Nothing that an archive says about itself is trusted: names are checked, and bytes are counted as they are unpacked.
Only plain files and folders are unpacked. Links, devices, encrypted files, and names that lead out of the folder are
refused.
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
from pathlib import Path
from typing import IO, Any, Final

from bufgym.ground.errors import BufgymError, where
from bufgym.ground.files import unpacked_limit
from bufgym.traces.datasets.connection import in_words
from bufgym.traces.datasets.download import disk

MAX_UNPACKED_BYTES: Final = 2 * 2**30
MAX_MEMBERS: Final = 100_000
ENDINGS: Final = (".zip", ".tar.gz", ".tgz", ".tar.bz2", ".tar.xz", ".tar")

# tarfile reads a header of any announced length at once; this is the longest that it may.
_MAX_READ_BYTES = 16 * 2**20
_BLOCK_BYTES = 2**20
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
    return next((suffix for suffix in ENDINGS if name.lower().endswith(suffix)), None)


def unpack(archive: Path, folder: Path, most_bytes: int | None = None) -> list[Path]:
    """Unpack `archive` into `folder`, which must not exist yet; after an error it does not exist either.

    Args:
        archive: named .zip, .tar, .tgz, .tar.gz, .tar.bz2 or .tar.xz.
        folder: created by this call, complete.
        most_bytes: limit of the bytes after decompression, MAX_UNPACKED_BYTES by default; never more than
            `unpacked_limit` of the archive's size.

    Returns:
        The files, in the archive's order.

    Raises:
        BufgymError: a damaged archive, one that is too big, or a member that must not be in the folder.
    """
    most_bytes = MAX_UNPACKED_BYTES if most_bytes is None else most_bytes
    with disk(archive):
        most_bytes = min(most_bytes, unpacked_limit(archive.stat().st_size))
    kind = ending(archive.name)
    members = _zip if kind == ".zip" else _tar
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    try:
        with disk(unfinished):
            unfinished.mkdir(parents=True)
        names = []
        remaining = most_bytes
        for name, stream in members(archive, most_bytes):
            target = _place(archive, unfinished, name)
            remaining -= _copy(archive, name, stream, target, remaining, most_bytes)
            names.append(target.relative_to(unfinished))
            if len(names) > MAX_MEMBERS:
                raise BufgymError(f"{archive}: more than {MAX_MEMBERS} files: must be fewer")
        if not names:
            raise BufgymError(f"{archive}: holds no file")
        with disk(folder):
            unfinished.rename(folder)
    except BufgymError:
        raise
    except _DAMAGED as error:
        raise BufgymError(f"{archive}: damaged, cut off, or no {kind} archive ({in_words(error)})") from None
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return [folder / name for name in names]


def _place(archive: Path, folder: Path, name: str) -> Path:
    parts = name.split("/")
    if name.startswith("/") or "\\" in name or ":" in name or "\0" in name or {"..", "."} & set(parts) or not name:
        raise BufgymError(where(archive, None, name, "leads out of its folder: must not", field="member"))
    target = folder.joinpath(*parts)
    if target.exists():
        raise BufgymError(where(archive, None, name, "must come only once", field="member"))
    return target


def _copy(archive: Path, name: str, stream: IO[bytes], target: Path, remaining: int, most_bytes: int) -> int:
    count = 0
    with disk(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        out = target.open("xb")
    with out:
        while block := stream.read(_BLOCK_BYTES):
            count += len(block)
            if count > remaining:
                raise _too_big(archive, name, most_bytes)
            with disk(target):
                out.write(block)
    return count


def _too_big(archive: Path, name: str, most_bytes: int) -> BufgymError:
    return BufgymError(f"{archive}: unpacks to more than {most_bytes} bytes (at {in_words(name)}): must be less")


def _zip(archive: Path, most_bytes: int) -> Iterator[tuple[str, IO[bytes]]]:
    with zipfile.ZipFile(archive) as opened:
        infos = opened.infolist()
        # Refuses an honest bomb before a byte is written; copying counts again, since both numbers may lie.
        if len(infos) > MAX_MEMBERS or sum(info.file_size for info in infos) > most_bytes:
            raise BufgymError(
                f"{archive}: unpacks to more than {most_bytes} bytes or {MAX_MEMBERS} files: must be less"
            )
        for info in infos:
            mode = info.external_attr >> 16
            if info.flag_bits & 1:
                raise BufgymError(where(archive, None, info.filename, "must not be encrypted", field="member"))
            if stat.S_IFMT(mode) not in (0, stat.S_IFREG, stat.S_IFDIR):
                raise BufgymError(where(archive, None, info.filename, "must be a plain file", field="member"))
            # Finder's folder of icons and attributes belongs to no data set.
            if not info.is_dir() and not info.filename.startswith("__MACOSX/"):
                with opened.open(info) as stream:
                    yield info.filename, stream


def _tar(archive: Path, most_bytes: int) -> Iterator[tuple[str, IO[bytes]]]:
    total = 0
    openers: dict[bytes, Any] = {b"\x1f\x8b": gzip.open, b"BZ": bz2.open, b"\xfd7": lzma.open}
    with archive.open("rb") as file:
        magic = file.read(2)
    with (
        openers.get(magic, open)(archive, "rb") as inner,
        tarfile.open(fileobj=_Bounded(archive, inner, most_bytes)) as opened,
    ):
        for number, member in enumerate(opened):
            if number >= MAX_MEMBERS:
                raise BufgymError(f"{archive}: more than {MAX_MEMBERS} members: must be fewer")
            if member.isdir():
                continue
            total += member.size
            if total > most_bytes:  # before a byte of it is written
                raise _too_big(archive, member.name, most_bytes)
            stream = opened.extractfile(member) if member.isreg() else None
            if stream is None:
                raise BufgymError(where(archive, None, member.name, "must be a plain file", field="member"))
            yield member.name.removeprefix("./"), stream


class _Bounded(io.RawIOBase):
    """The decompressed bytes of a tar file, up to a limit that leaves room for its headers."""

    def __init__(self, archive: Path, inner: IO[bytes], most_bytes: int) -> None:
        self._archive, self._inner, self._most_bytes = archive, inner, most_bytes
        self._limit = most_bytes + 3 * tarfile.BLOCKSIZE * MAX_MEMBERS

    def read(self, size: int = -1) -> bytes:
        if size > _MAX_READ_BYTES:
            raise BufgymError(f"{self._archive}: a header of {size} bytes: must be at most {_MAX_READ_BYTES}")
        return self._inner.read(size)

    def seek(self, offset: int, whence: int = 0) -> int:
        if offset > self._limit:
            raise BufgymError(f"{self._archive}: unpacks to more than {self._most_bytes} bytes: must be less")
        return self._inner.seek(offset, whence)

    def tell(self) -> int:
        return self._inner.tell()
