"""Unpack untrusted zip and tar archives: inside their folder, up to a stated size, or not at all.

Only plain files and folders are unpacked. Links, devices, and names that lead out of the folder are refused. A size
that an archive states is checked before a byte is written, and the libraries read no more than it.
"""

import gzip
import io
import shutil
import stat
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Final

from bufgym.traces.formats.faults import os_errors
from bufgym.utils.errors import BufgymError, where
from bufgym.utils.files import unpacked_limit

MAX_UNPACKED_BYTES: Final = 2 * 2**30
MAX_MEMBERS: Final = 100_000

# tarfile reads a header of any announced length at once; this is the longest that it may.
_MAX_READ_BYTES = 16 * 2**20


def ending(name: str) -> str | None:
    """The ending that marks a file as an archive, None if it has no such ending."""
    return next((suffix for suffix in _UNPACKERS if name.lower().endswith(suffix)), None)


def unpack(archive: Path, folder: Path, most_bytes: int = MAX_UNPACKED_BYTES) -> None:
    """Unpack `archive` (.zip, .tgz, .tar.gz) into a new `folder`; after an error the folder does not exist.

    It must hold at most `most_bytes` after decompression, and never more than `unpacked_limit` of its size.

    Raises:
        BufgymError: a damaged archive, one that is too big, or a member that must not be in the folder.
    """
    kind = ending(archive.name)
    assert kind is not None
    most_bytes = min(most_bytes, unpacked_limit(archive.stat().st_size))
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    names: set[str] = set()
    total = 0

    def check(name: str, size_bytes: int, is_plain: bool) -> None:
        nonlocal total
        total += size_bytes
        leads_out = name.startswith("/") or "\\" in name or ":" in name or ".." in name.split("/")
        for broken, rule in (
            (not is_plain, "must be a plain file"),
            (leads_out, "leads out of its folder: must not"),
            (name in names, "must come only once"),
            (
                total > most_bytes or len(names) >= MAX_MEMBERS,
                f"unpacks to more than {most_bytes} bytes or {MAX_MEMBERS} files: must be less",
            ),
        ):
            if broken:
                raise BufgymError(where(archive, None, name, rule, field="member"))
        names.add(name)

    try:
        _UNPACKERS[kind](archive, unfinished, check)
        if not unfinished.exists():
            raise BufgymError(f"{archive}: holds no file")
        with os_errors(folder, "written"):
            unfinished.rename(folder)
    except BufgymError:
        raise
    except Exception as error:  # the libraries raise nearly anything on broken archives
        raise BufgymError(f"{archive}: damaged, cut off, or no {kind} archive ({str(error)[:200]})") from None
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)


Check = Callable[[str, int, bool], None]
"""Called with each member's name, its size, and whether it is a plain file or a folder."""


def _unzip(archive: Path, folder: Path, check: Check) -> None:
    with zipfile.ZipFile(archive) as packed:
        # Finder's folder of icons and attributes belongs to no data set.
        members = [info for info in packed.infolist() if not info.filename.startswith("__MACOSX/")]
        for info in members:
            kind = stat.S_IFMT(info.external_attr >> 16)
            check(info.filename, info.file_size, kind in (0, stat.S_IFREG, stat.S_IFDIR))
        packed.extractall(folder, members)


def _untar(archive: Path, folder: Path, check: Check) -> None:
    with gzip.open(archive) as stream, tarfile.open(fileobj=_BoundedArchive(archive, stream)) as packed:
        packed.extraction_filter = getattr(tarfile, "data_filter", None)  # not in the oldest Pythons
        for member in packed:
            check(member.name, member.size, member.isreg() or member.isdir())
            packed.extract(member, folder)


_UNPACKERS: Final[dict[str, Callable[[Path, Path, Check], None]]] = {".tar.gz": _untar, ".tgz": _untar, ".zip": _unzip}


class _BoundedArchive(io.RawIOBase):
    """The decompressed bytes of a tar file, a limited number at once."""

    def __init__(self, archive: Path, inner: gzip.GzipFile) -> None:
        self._archive, self._inner = archive, inner
        self.seek, self.tell = inner.seek, inner.tell  # type: ignore[method-assign]

    def read(self, size: int = -1) -> bytes:
        if size > _MAX_READ_BYTES:
            raise BufgymError(f"{self._archive}: a header of {size} bytes: must be at most {_MAX_READ_BYTES}")
        return self._inner.read(size)
