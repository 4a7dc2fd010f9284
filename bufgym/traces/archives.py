"""Zip archives as folders of text files: one member, found by name, opened with suspicion.

`archive.zip` stands for its only member, `archive.zip:name` for the one of that name or with that ending
(`name` or `.../name`), as long as no two have it. Folders, hidden files and the `__MACOSX` twins that some
systems put in do not count. Beyond these limits an archive is refused: 4 MiB for its list of members (some 50,000
of them), members stored or deflated only (other methods may ask for gigabytes to unpack a few bytes), none
encrypted. How much may come out of a member is `files.MAX_TEXT_BYTES`.
"""

from __future__ import annotations

import gzip
import io
import struct
import zipfile
import zlib
from os import PathLike, fspath
from pathlib import Path
from typing import Final, cast

from bufgym.errors import TraceError, where

ZIP_MAGIC: Final = b"PK"
MAX_DIRECTORY_BYTES: Final = 4 * 2**20

# What reading packed data raises where they are not what was packed.
DAMAGED: Final = (EOFError, zlib.error, gzip.BadGzipFile, zipfile.BadZipFile)

_MARK: Final = ".zip:"
_METHODS: Final = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED: Final = 1
_SHOWN_MEMBERS: Final = 3


def split_member(path: str | PathLike[str]) -> tuple[Path, str | None]:
    """`archive.zip:member` as (archive.zip, member); any other path, and any file that exists, as (path, None)."""
    text = fspath(path)
    at = text.find(_MARK)
    if at < 0 or Path(text).exists():
        return Path(text), None
    return Path(text[: at + len(_MARK) - 1]), text[at + len(_MARK) :]


def members(path: str | PathLike[str]) -> list[str]:
    """The files that the zip archive holds, in its order; empty for a file that is no zip.

    Raises:
        TraceError: it cannot be read, or its list of members is damaged or too long.
    """
    try:
        with open(path, "rb") as raw:
            if raw.peek(2)[:2] != ZIP_MAGIC:
                return []
            with _archive(path, raw) as archive:
                return [info.filename for info in _files(archive)]
    except OSError as error:
        raise TraceError(where(path, None, None, f"cannot be read: {error.strerror or error}")) from error


def open_member(path: str | PathLike[str], raw: io.BufferedReader, member: str | None) -> zipfile.ZipExtFile:
    """The member's bytes, unpacked as they are read. `path` is what error messages name.

    Raises:
        TraceError: the archive is damaged, holds several files and `member` says not which, has none of that
            name, or the member is encrypted or packed by another method than those above.
    """
    with _archive(path, raw) as archive:
        info = _chosen(path, _files(archive), member)
        if info.flag_bits & _ENCRYPTED:
            raise TraceError(where(path, None, info.filename, "is encrypted: must not be", field="member"))
        if info.compress_type not in _METHODS:
            raise TraceError(where(path, None, info.filename, "must be stored or deflated", field="member"))
        try:
            # It stays readable after its archive is closed.
            return cast(zipfile.ZipExtFile, archive.open(info))
        except (*DAMAGED, ValueError, struct.error, RuntimeError) as error:
            raise TraceError(where(path, None, None, f"zip data damaged or cut off ({error})")) from error


class _Bounded:
    """A file that refuses to hand out more at once than a list of members may have; who opened it closes it."""

    def __init__(self, raw: io.BufferedReader) -> None:
        self.seek, self.tell, self.seekable = raw.seek, raw.tell, raw.seekable
        self._read = raw.read

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > MAX_DIRECTORY_BYTES:
            raise zipfile.BadZipFile(f"list of members of {size} bytes: must be at most {MAX_DIRECTORY_BYTES}")
        return self._read(size)


def _archive(path: str | PathLike[str], raw: io.BufferedReader) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(_Bounded(raw))
    except (*DAMAGED, ValueError, struct.error, NotImplementedError, OverflowError) as error:
        raise TraceError(where(path, None, None, f"zip data damaged or cut off ({error})")) from error


def _files(archive: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    return [
        info
        for info in archive.infolist()
        if not info.is_dir()
        and not info.filename.startswith("__MACOSX/")
        and not info.filename.rpartition("/")[2].startswith(".")
    ]


def _chosen(path: str | PathLike[str], files: list[zipfile.ZipInfo], member: str | None) -> zipfile.ZipInfo:
    if member is None:
        if len(files) == 1:
            return files[0]
        raise TraceError(where(path, None, None, f"must name one as archive.zip:member: holds {_listed(files)}"))
    found = [info for info in files if info.filename == member] or [
        info for info in files if info.filename.endswith(f"/{member}")
    ]
    if len(found) == 1:
        return found[0]
    if found:
        raise TraceError(where(path, None, member, f"fits {_listed(found)}: must fit one", field="member"))
    raise TraceError(where(path, None, member, f"must be one of its {_listed(files)}", field="member"))


def _listed(files: list[zipfile.ZipInfo]) -> str:
    names = [info.filename[:80] for info in files[:_SHOWN_MEMBERS]]
    more = [f"... {len(files) - len(names)} more"] if len(files) > len(names) else []
    return f"{len(files)} members ({', '.join(names + more) or 'none'})"
