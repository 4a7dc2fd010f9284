"""Download a file from an http or https address over a network that breaks off.

The bytes go into a part file. A record beside it identifies the file by its address, its length and its version, which
is the ETag or else the Last-Modified date. Another attempt, in this process or a later one, asks for the rest alone
(RFC 9110: Range with If-Range, 206 and Content-Range). It starts over when the file has changed in the meantime or the
server does not support ranges.

HTTP is the standard library's urllib. pooch verifies checksums and keeps a cache, but cannot resume a part file, and
would bring in requests and platformdirs.
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
from bufgym.ground.errors import BufgymError
from bufgym.traces.datasets.connection import BrokenError, in_words, opened

Progress: TypeAlias = "Callable[[int, int | None], None]"
"""Called with the bytes on disk and the file's length (None if the server does not say)."""

MAX_BYTES: Final = 64 * 2**30
"""No file may be longer."""
HEADWAY_BYTES: Final = 2**18
"""An attempt with at least this many new bytes is no failure, so that a long file gets through a bad link too."""
MAX_WAIT_S: Final = 60.0
"""Longest pause between two attempts, s."""

_BLOCK_BYTES = 2**16
_CONTENT_RANGE = re.compile(r"bytes (\d+)-\d+/(\d+|\*)")


@dataclass(frozen=True)
class Patience:
    """Number of attempts, pauses between them, and time limit."""

    attempts: int = 5
    """Give up after so many failures in a row."""
    first_wait_s: float = 1.0
    """Pause after the first failure, s; each further pause is twice as long."""
    silence_s: float = 30.0
    """An attempt fails when the server sends nothing for so long, s."""


@dataclass(frozen=True)
class _Record:
    """Which file the bytes of a part file belong to."""

    address: str
    version: str | None
    total: int | None


def download(address: str, part: Path, progress: Progress | None = None, patience: Patience | None = None) -> None:
    """Download the file at `address` into `part`, resuming if some of it is there.

    Args:
        address: http or https.
        part: the file to write; its record is `part` with `.json` appended. After a failure both stay, so that a later
            call can resume.
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
            return _attempt(address, part, progress or (lambda count, total: None), patience.silence_s)
        except BrokenError as broken:
            if broken.stale:
                discard(part)
            kept = size(part)
            failures = 1 if kept >= reached + HEADWAY_BYTES else failures + 1
            reached = max(reached, kept)
            if failures >= patience.attempts:
                resume = f"; {kept} bytes are kept: run the same command again to resume" if kept else ""
                raise BufgymError(f"{address}: {broken} (gave up after {failures} attempts){resume}") from None
            time.sleep(min(max(patience.first_wait_s * 2 ** (failures - 1), broken.wait_s), MAX_WAIT_S))


def discard(part: Path) -> None:
    """Remove a part file and its record."""
    part.unlink(missing_ok=True)
    _record_path(part).unlink(missing_ok=True)


def size(path: Path) -> int:
    """Bytes in the file; 0 if there is none."""
    return path.stat().st_size if path.exists() else 0


def refuse_page(source: object, start: bytes) -> None:
    """Raise BufgymError if these first bytes are of an HTML page: a log-in, or an error page with code 200."""
    if start.lstrip(b"\xef\xbb\xbf \t\r\n")[:14].lower().startswith((b"<!doctype html", b"<html")):
        raise _page(source)


def _page(source: object) -> BufgymError:
    return BufgymError(f"{source}: is an HTML page, not data (a log-in or error page?)")


@contextmanager
def disk(path: Path) -> Iterator[None]:
    """Turn what the disk refuses into a BufgymError of one line."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise BufgymError(f"{path.parent}: the disk is full: make room and run the same command again") from None
        raise BufgymError(f"{error.filename or path}: cannot be written: {error.strerror or error}") from None


# --- one attempt ------------------------------------------------------------------------------------------------------


def _attempt(address: str, part: Path, progress: Progress, silence_s: float) -> None:
    record = _read_record(part)
    resume_at = size(part) if record is not None and record.address == address else 0
    request = urllib.request.Request(
        address, headers={"User-Agent": f"bufgym/{__version__}", "Accept-Encoding": "identity"}
    )
    if record is not None and resume_at:
        if resume_at == record.total:
            return
        if record.version is not None:
            request.add_header("Range", f"bytes={resume_at}-")
            request.add_header("If-Range", record.version)
    with opened(request, silence_s) as response:
        start, total = _extent(address, response)
        version = _version(response)
        if start and not (
            record is not None
            and start == resume_at
            and version in (None, record.version)
            and record.total in (None, total)
        ):
            raise BrokenError("the server sent another part than the one requested", stale=True)
        block = _read(response)
        if not start:
            refuse_page(address, block)
            if not block:
                raise BrokenError("the server sent nothing")
        _check_room(part, start, total)
        if not start:
            _write_record(part, _Record(address, version, total))
        _save(address, response, block, part, start, total, progress)


def _save(
    address: str,
    response: http.client.HTTPResponse,
    block: bytes,
    part: Path,
    start: int,
    total: int | None,
    progress: Progress,
) -> None:
    """Write `block` and what follows it, from byte `start` on, unbuffered: every byte survives if we are killed."""
    count = start
    with disk(part), part.open("r+b" if part.exists() else "w+b", buffering=0) as out:
        out.truncate(start)
        out.seek(start)
        while block:
            if count + len(block) > (MAX_BYTES if total is None else total):
                out.truncate(0)
                raise BufgymError(f"{address}: sends more bytes than the {total or MAX_BYTES} announced or allowed")
            _write(out, block)
            count += len(block)
            progress(count, total)
            try:
                block = _read(response)
            except BrokenError:
                if count != total:
                    raise
                break
    if total is not None and count < total:
        raise BrokenError(f"the connection was cut after {count} of {total} bytes")


def _write(out: IO[bytes], block: bytes) -> None:
    while block:
        block = block[out.write(block) :]


def _read(response: http.client.HTTPResponse) -> bytes:
    try:
        return response.read1(_BLOCK_BYTES)
    except TimeoutError:
        raise BrokenError("the server fell silent") from None
    except (OSError, http.client.HTTPException) as error:
        raise BrokenError(f"the connection broke ({in_words(error)})") from None


def _extent(address: str, response: http.client.HTTPResponse) -> tuple[int, int | None]:
    """The first byte that the response holds, and the length of the whole file (None if not announced)."""
    encoding = response.headers.get("Content-Encoding", "identity")
    if encoding.lower() != "identity":
        raise BufgymError(f"{address}: comes with Content-Encoding {in_words(encoding)}, which was not requested")
    if response.headers.get_content_type() in ("text/html", "application/xhtml+xml"):
        raise _page(address)
    length = response.length
    if response.will_close and not response.chunked:
        # Read to the end of the connection, to notice bytes beyond the announced length.
        response.length = None
    if response.status not in (200, 206):
        raise BufgymError(
            f"{address}: the server says {response.status} {in_words(response.reason)}, which brings no file"
        )
    if response.status == 200:
        return 0, length
    match = _CONTENT_RANGE.fullmatch(response.headers.get("Content-Range", "").strip())
    if match is None:
        raise BufgymError(f"{address}: sends a part of the file without saying which")
    start = int(match[1])
    return start, int(match[2]) if match[2] != "*" else length and start + length


def _check_room(part: Path, start: int, total: int | None) -> None:
    if total is None:
        return
    if total > MAX_BYTES:
        raise BufgymError(f"{part.parent}: a file of {total} bytes: must be at most {MAX_BYTES}")
    free = shutil.disk_usage(part.parent).free
    if total - start > free:
        raise BufgymError(f"{part.parent}: the disk is full: {total - start} bytes are needed, {free} are free")


def _version(response: http.client.HTTPResponse) -> str | None:
    """What If-Range can name: a strong ETag, else the date of the last change."""
    etag = response.headers.get("ETag")
    return etag if etag is not None and not etag.startswith("W/") else response.headers.get("Last-Modified")


# --- the record beside the part ---------------------------------------------------------------------------------------


def _record_path(part: Path) -> Path:
    return part.with_name(part.name + ".json")


def _read_record(part: Path) -> _Record | None:
    try:
        entry = json.loads(_record_path(part).read_text(encoding="utf-8"))
        return _Record(entry["address"], entry["version"], entry["total"])
    except (OSError, ValueError, TypeError, KeyError):
        return None  # the origin of the part file is unknown, so it is fetched again


def _write_record(part: Path, record: _Record) -> None:
    """Remove the old bytes before writing the new record: if we are killed in between, the two cannot disagree."""
    with disk(part):
        discard(part)
        _record_path(part).write_text(json.dumps(vars(record)), encoding="utf-8")
