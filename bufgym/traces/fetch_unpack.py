"""zip and tar archives from strangers: unpacked inside their folder, up to a stated size, or refused.

What an archive says of itself is not believed: names are checked, bytes are counted as they come out. Only plain files
and folders come out; links, devices, encrypted files, and names that lead out of the folder end in a BufgymError.
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

from bufgym.errors import BufgymError, where
from bufgym.traces.fetch_connection import in_words
from bufgym.traces.fetch_http import disk

MAX_UNPACKED_BYTES: Final = 2 * 2**30
MAX_MEMBERS: Final = 100_000
ENDINGS: Final = (".zip", ".tar.gz", ".tgz", ".tar.bz2", ".tar.xz", ".tar")

# The longest that is read at once: tarfile takes a header of any announced length in one go.
_MAX_READ = 16 * 2**20
_BLOCK = 2**20
# What the libraries raise of broken archives, as found by breaking some.
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
    """The ending by which a file is known as an archive."""
    return next((each for each in ENDINGS if name.lower().endswith(each)), None)


def unpack(archive: Path, folder: Path, most_bytes: int | None = None) -> list[Path]:
    """Unpack `archive` into `folder`, which must not be there yet: after an error it is not there either.

    Args:
        archive: named .zip, .tar, .tgz, .tar.gz, .tar.bz2 or .tar.xz.
        folder: made by this call, whole.
        most_bytes: bytes after decompression, MAX_UNPACKED_BYTES by default.

    Returns:
        The files, in the archive's order.

    Raises:
        BufgymError: a damaged archive, one too big, or a member that has no place in the folder.
    """
    most_bytes = MAX_UNPACKED_BYTES if most_bytes is None else most_bytes
    kind = ending(archive.name)
    members = _zip if kind == ".zip" else _tar
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    try:
        with disk(unfinished):
            unfinished.mkdir(parents=True)
        names = []
        left = most_bytes
        for name, stream in members(archive, most_bytes):
            target = _place(archive, unfinished, name)
            left -= _copy(archive, name, stream, target, left, most_bytes)
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


def _copy(archive: Path, name: str, stream: IO[bytes], target: Path, left: int, most_bytes: int) -> int:
    count = 0
    with disk(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        out = target.open("xb")
    with out:
        while block := stream.read(_BLOCK):
            count += len(block)
            if count > left:
                raise _too_big(archive, name, most_bytes)
            with disk(target):
                out.write(block)
    return count


def _too_big(archive: Path, name: str, most_bytes: int) -> BufgymError:
    return BufgymError(f"{archive}: unpacks to more than {most_bytes} bytes (at {in_words(name)}): must be less")


def _zip(archive: Path, most_bytes: int) -> Iterator[tuple[str, IO[bytes]]]:
    with zipfile.ZipFile(archive) as opened:
        infos = opened.infolist()
        # Both may lie, which the copying finds out; an honest bomb is refused before a byte is written.
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
            # Finder's folder of icons and attributes is no part of any data set.
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
    """The decompressed bytes of a tar file, up to a limit that leaves room for headers."""

    def __init__(self, archive: Path, inner: IO[bytes], most_bytes: int) -> None:
        self._archive, self._inner, self._stated = archive, inner, most_bytes
        self._limit = most_bytes + 3 * tarfile.BLOCKSIZE * MAX_MEMBERS

    def read(self, size: int = -1) -> bytes:
        if size > _MAX_READ:
            raise BufgymError(f"{self._archive}: a header of {size} bytes: must be at most {_MAX_READ}")
        return self._inner.read(size)

    def seek(self, offset: int, whence: int = 0) -> int:
        if offset > self._limit:
            raise BufgymError(f"{self._archive}: unpacks to more than {self._stated} bytes: must be less")
        return self._inner.seek(offset, whence)

    def tell(self) -> int:
        return self._inner.tell()
