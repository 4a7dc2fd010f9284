"""A file from an http or https address onto the disk, over a network that breaks off.

The bytes go into a part file; beside it a record says whose bytes these are: the address, the version of the file by
its ETag or else its Last-Modified date, the length. Another attempt, in this process or in a later one, asks for the
rest alone (RFC 9110: Range with If-Range, 206 and Content-Range), and starts anew where the file has changed meanwhile
or the server does not know ranges.

The standard library's urllib, and not pooch: pooch checks sums and keeps a cache, but it cannot go on with a part file
and would bring in requests and platformdirs; what is needed beyond that is in this module.
"""

from __future__ import annotations

import errno
import http.client
import json
import re
import shutil
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final, TypeAlias
from urllib.parse import urlsplit

from bufgym import __version__
from bufgym.errors import BufgymError
from bufgym.traces.fetch_connection import BrokenError, in_words, opened

Progress: TypeAlias = "Callable[[int, int | None], None]"
"""Hears of the bytes that are there, and of how many there will be, if the server says so."""

MAX_BYTES: Final = 64 * 2**30
"""No file may be longer."""
HEADWAY_BYTES: Final = 2**18
"""An attempt that brought as many new bytes was no failure, so that a long file comes over a bad link too."""
MAX_WAIT_S: Final = 60.0

_BLOCK = 2**16
_CONTENT_RANGE = re.compile(r"bytes (\d+)-\d+/(\d+|\*)")


@dataclass(frozen=True)
class Patience:
    """How often, how soon and how long to try: each wait is twice the one before, a silent server is given up."""

    attempts: int = 5
    first_wait_s: float = 1.0
    silence_s: float = 30.0


@dataclass(frozen=True)
class _Record:
    """Whose bytes a part file holds."""

    address: str
    version: str | None
    total: int | None


def download(address: str, part: Path, progress: Progress | None = None, patience: Patience | None = None) -> None:
    """Bring the file at `address` into `part`, going on with what is there of it.

    Args:
        address: http or https.
        part: the file to write; `part` with `.json` after its name is written too. After a failure both stay, for a
            later call to go on with.
        progress: called after every block.
        patience: when to give up.

    Raises:
        BufgymError: no network, no such file, a server that fails or breaks off again and again, an HTML page, more or
            fewer bytes than announced, no room on the disk.
    """
    if urlsplit(address).scheme not in ("http", "https"):
        raise BufgymError(f"{address}: must be an http or https address")
    patience = patience or Patience()
    failures, reached = 0, size(part)
    while True:
        try:
            return _attempt(address, part, progress, patience.silence_s)
        except BrokenError as broken:
            if broken.stale:
                discard(part)
            there = size(part)
            failures = 1 if there >= reached + HEADWAY_BYTES else failures + 1
            reached = max(reached, there)
            if failures >= patience.attempts:
                kept = f"; {there} bytes are kept: run the same command again to go on" if there else ""
                raise BufgymError(f"{address}: {broken} (given up after {failures} attempts){kept}") from None
            time.sleep(min(max(patience.first_wait_s * 2 ** (failures - 1), broken.wait_s), MAX_WAIT_S))


def discard(part: Path) -> None:
    """Remove a part file and its record."""
    part.unlink(missing_ok=True)
    _record_of(part).unlink(missing_ok=True)


def size(path: Path) -> int:
    """Bytes in the file; 0 if there is none."""
    return path.stat().st_size if path.exists() else 0


def refuse_page(source: object, start: bytes) -> None:
    """An HTML page where data should be: a log-in, an error page that comes with code 200, a network's portal."""
    if start.lstrip(b"\xef\xbb\xbf \t\r\n")[:14].lower().startswith((b"<!doctype html", b"<html")):
        raise BufgymError(f"{source}: is an HTML page, not data (a log-in or error page?)")


@contextmanager
def disk(path: Path) -> Iterator[None]:
    """What the disk refuses, in one line."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise BufgymError(f"{path.parent}: the disk is full: make room and run the same command again") from None
        raise BufgymError(f"{error.filename or path}: cannot be written: {error.strerror or error}") from None


# --- one attempt ------------------------------------------------------------------------------------------------------


def _attempt(address: str, part: Path, progress: Progress | None, silence_s: float) -> None:
    record = _read_record(part)
    at = size(part) if record is not None and record.address == address else 0
    if record is not None and at and at == record.total:
        return
    request = urllib.request.Request(
        address, headers={"User-Agent": f"bufgym/{__version__}", "Accept-Encoding": "identity"}
    )
    if record is not None and record.version is not None and at:
        request.add_header("Range", f"bytes={at}-")
        request.add_header("If-Range", record.version)
    with opened(request, silence_s) as response:
        start, total = _told(address, response)
        if start and not _goes_on(record, at, start, total, _version(response)):
            raise BrokenError("the server sent another part than was asked for", stale=True)
        first = _read(response)
        if not start:
            refuse_page(address, first)
        if not first and not start:
            raise BrokenError("the server sent nothing")
        _check_room(part, start, total)
        if not start:
            _write_record(part, _Record(address, _version(response), total))
        _take(address, response, first, part, start, total, progress)


def _goes_on(record: _Record | None, at: int, start: int, total: int | None, version: str | None) -> bool:
    """Whether a part that begins with byte `start` is of the same file and begins where ours ends."""
    return (
        record is not None
        and start == at
        and version in (None, record.version)
        and (record.total is None or record.total == total)
    )


def _take(
    address: str,
    response: http.client.HTTPResponse,
    block: bytes,
    part: Path,
    at: int,
    total: int | None,
    progress: Progress | None,
) -> None:
    """Write from byte `at` on until the server has no more. Unbuffered: what came is there even if we are killed."""
    with disk(part), part.open("r+b" if part.exists() else "w+b", buffering=0) as out:
        out.truncate(at)
        out.seek(at)
        while block:
            if at + len(block) > (MAX_BYTES if total is None else total):
                out.truncate(0)
                raise BufgymError(f"{address}: sends more bytes than the {total or MAX_BYTES} announced or allowed")
            _write(out, block)
            at += len(block)
            if progress is not None:
                progress(at, total)
            try:
                block = _read(response)
            except BrokenError:
                if at != total:
                    raise
                break
    if total is not None and at < total:
        raise BrokenError(f"the connection was cut after {at} of {total} bytes")


def _write(out: IO[bytes], block: bytes) -> None:
    while block:
        block = block[out.write(block) :]


def _read(response: http.client.HTTPResponse) -> bytes:
    try:
        return response.read1(_BLOCK)
    except TimeoutError:
        raise BrokenError("the server fell silent") from None
    except (OSError, http.client.HTTPException) as error:
        raise BrokenError(f"the connection broke ({in_words(error)})") from None


def _told(address: str, response: http.client.HTTPResponse) -> tuple[int, int | None]:
    """The first byte that the answer holds, and the length of the whole file (None: not announced)."""
    if response.headers.get("Content-Encoding", "identity").lower() != "identity":
        raise BufgymError(
            f"{address}: comes with Content-Encoding {in_words(response.headers['Content-Encoding'])}, not asked for"
        )
    if response.headers.get_content_type() in ("text/html", "application/xhtml+xml"):
        raise BufgymError(f"{address}: is an HTML page, not data (a log-in or error page?)")
    length = response.length
    if response.will_close and not response.chunked:
        # Read to the end of the connection, to notice what comes beyond the announced length.
        response.length = None
    if response.status not in (200, 206):
        raise BufgymError(
            f"{address}: the server says {response.status} {in_words(response.reason)}, which brings no file"
        )
    if response.status == 206:
        match = _CONTENT_RANGE.fullmatch(response.headers.get("Content-Range", "").strip())
        if match is None:
            raise BufgymError(f"{address}: sends a part of the file without saying which")
        return int(match[1]), int(match[2]) if match[2] != "*" else length and int(match[1]) + length
    return 0, length


def _check_room(part: Path, at: int, total: int | None) -> None:
    if total is None:
        return
    if total > MAX_BYTES:
        raise BufgymError(f"{part.parent}: a file of {total} bytes: must be at most {MAX_BYTES}")
    free = shutil.disk_usage(part.parent).free
    if total - at > free:
        raise BufgymError(f"{part.parent}: the disk is full: {total - at} bytes are needed, {free} are free")


def _version(response: http.client.HTTPResponse) -> str | None:
    """What If-Range can name: a strong ETag, else the date of the last change."""
    etag = response.headers.get("ETag")
    return etag if etag is not None and not etag.startswith("W/") else response.headers.get("Last-Modified")


# --- the record beside the part ---------------------------------------------------------------------------------------


def _record_of(part: Path) -> Path:
    return part.with_name(part.name + ".json")


def _read_record(part: Path) -> _Record | None:
    try:
        found = json.loads(_record_of(part).read_text(encoding="utf-8"))
        return _Record(found["address"], found["version"], found["total"])
    except (OSError, ValueError, TypeError, KeyError):
        return None  # then the part file's origin is not known, and it is fetched anew


def _write_record(part: Path, record: _Record) -> None:
    """The old bytes go before the new record comes: killed in between, nothing is taken for what it is not."""
    with disk(part):
        discard(part)
        _record_of(part).write_text(json.dumps(vars(record)), encoding="utf-8")
