"""Zip archives as folders of text files: finds one member by name, and opens it with bounds.

`archive.zip` stands for its only member. `archive.zip:name` stands for the member with that name or ending (`name` or
`.../name`), as long as only one has it. Folders, hidden files and the `__MACOSX` twins that some systems add do not
count. An archive is refused if its list of members is over 4 MiB (some 50,000 of them). A member is refused if it is
encrypted or neither stored nor deflated, as other methods may unpack a few bytes to gigabytes. A member's limit is
`text.MAX_TEXT_BYTES`.
"""

from __future__ import annotations

import gzip
import io
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from os import fspath
from pathlib import Path
from typing import Final, cast

from bufgym.traces.formats.faults import StrPath, fault, os_errors

ZIP_MAGIC: Final = b"PK"
MAX_DIRECTORY_BYTES: Final = 4 * 2**20

# What reading packed data raises when it is damaged, and what reading a damaged list of members raises.
_Exceptions = tuple[type[Exception], ...]
_DAMAGED_DATA: Final[_Exceptions] = (EOFError, zlib.error, gzip.BadGzipFile, zipfile.BadZipFile)
_DAMAGED_LIST: Final[_Exceptions] = (*_DAMAGED_DATA, ValueError, struct.error, RuntimeError, OverflowError)

_MARK: Final = ".zip:"
_METHODS: Final = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED: Final = 1
_LISTED_MEMBERS: Final = 3


@contextmanager
def damage_errors(
    path: StrPath, packing: str, line: int | None = None, damaged: _Exceptions = _DAMAGED_DATA
) -> Iterator[None]:
    """Turn the exceptions that mean damaged data into a TraceError."""
    try:
        yield
    except damaged as error:
        raise fault(path, f"{packing} data damaged or cut off ({error})", line=line) from error


def split_member(path: StrPath) -> tuple[Path, str | None]:
    """`archive.zip:member` as (archive.zip, member); any other path, and any file that exists, as (path, None)."""
    text = fspath(path)
    archive, mark, member = text.partition(_MARK)
    if not mark or Path(text).exists():
        return Path(text), None
    return Path(archive + mark[:-1]), member


def members(path: StrPath) -> list[str]:
    """The files that the zip archive holds, in its order; empty for a file that is no zip.

    Raises:
        TraceError: it cannot be read, or its list of members is damaged or too long.
    """
    with os_errors(path, "read"), open(path, "rb") as raw:
        if raw.peek(2)[:2] != ZIP_MAGIC:
            return []
        with _archive(path, raw) as archive:
            return [info.filename for info in _files(archive)]


def open_member(path: StrPath, raw: io.BufferedReader, member: str | None) -> zipfile.ZipExtFile:
    """The member's bytes, unpacked as they are read.

    Args:
        path: the archive, for error messages.
        raw: the archive, open.
        member: its name or the end of it; None for the only one.

    Raises:
        TraceError: the archive is damaged, `member` does not name exactly one file, or that file is encrypted or packed
            by a method other than those above.
    """
    with _archive(path, raw) as archive:
        info = _chosen(path, _files(archive), member)
        if info.flag_bits & _ENCRYPTED:
            raise fault(path, "is encrypted: must not be", value=info.filename, field="member")
        if info.compress_type not in _METHODS:
            raise fault(path, "must be stored or deflated", value=info.filename, field="member")
        with damage_errors(path, "zip", damaged=_DAMAGED_LIST):
            # It stays readable after its archive is closed.
            return cast(zipfile.ZipExtFile, archive.open(info))


class _Bounded:
    """An open file that refuses to read more at once than a list of members may have; its opener closes it."""

    def __init__(self, raw: io.BufferedReader) -> None:
        self.seek, self.tell, self.seekable = raw.seek, raw.tell, raw.seekable
        self._read = raw.read

    def read(self, size: int | None = -1, /) -> bytes:
        if size is not None and size > MAX_DIRECTORY_BYTES:
            raise zipfile.BadZipFile(f"list of members of {size} bytes: must be at most {MAX_DIRECTORY_BYTES}")
        return self._read(size)


def _archive(path: StrPath, raw: io.BufferedReader) -> zipfile.ZipFile:
    with damage_errors(path, "zip", damaged=_DAMAGED_LIST):
        return zipfile.ZipFile(_Bounded(raw))


def _files(archive: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    return [
        info
        for info in archive.infolist()
        if not info.is_dir()
        and not info.filename.startswith("__MACOSX/")
        and not info.filename.rpartition("/")[2].startswith(".")
    ]


def _chosen(path: StrPath, files: list[zipfile.ZipInfo], member: str | None) -> zipfile.ZipInfo:
    if member is None:
        if len(files) == 1:
            return files[0]
        raise fault(path, f"must name one as archive.zip:member: holds {_listed(files)}")
    matches = [info for info in files if info.filename == member] or [
        info for info in files if info.filename.endswith(f"/{member}")
    ]
    if len(matches) == 1:
        return matches[0]
    rule = f"fits {_listed(matches)}: must fit one" if matches else f"must be one of its {_listed(files)}"
    raise fault(path, rule, value=member, field="member")


def _listed(files: list[zipfile.ZipInfo]) -> str:
    names = [info.filename[:80] for info in files[:_LISTED_MEMBERS]]
    more = [f"... {len(files) - len(names)} more"] if len(files) > len(names) else []
    return f"{len(files)} members ({', '.join(names + more) or 'none'})"
