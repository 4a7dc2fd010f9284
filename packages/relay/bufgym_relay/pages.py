"""The relay's page over HTTP on the same port; it serves the files of one folder and nothing else."""

import email.utils
import functools
import gzip
import hashlib
import mimetypes
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from pathlib import Path
from typing import Final

from websockets.datastructures import Headers
from websockets.http11 import Response

FOLDER: Final = Path(__file__).with_name("page")
POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; "
    "form-action 'self'; connect-src 'self' ws: wss:; frame-ancestors 'none'; base-uri 'none'"
)
HEADERS: Final = {
    "Cache-Control": "no-cache",
    "Connection": "close",
    "Content-Security-Policy": POLICY,
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


def answer(path: str, asked: Headers, folder: Path = FOLDER, origins: Sequence[str] = ()) -> Response:
    """Answer a GET of this path; ``asked`` has the request's headers. Nothing is sent that the browser has already.

    The page may fetch from these other ``origins``, too.
    """
    name = path.partition("?")[0].removeprefix("/") or "index.html"
    files = {file.name: file for file in folder.iterdir() if file.is_file()} if folder.is_dir() else {}
    if name not in files:  # a name that was not listed is never opened: no "..", no absolute path
        return response(HTTPStatus.NOT_FOUND, "no such page\n")
    data, packed, tag = _read(files[name], files[name].stat().st_mtime_ns)
    kind = mimetypes.guess_type(name)[0] or "text/plain"
    more = {"ETag": tag, "Vary": "Accept-Encoding"}
    more["Content-Security-Policy"] = POLICY.replace(" wss:", " ".join([" wss:", *origins]))
    if tag in asked.get("If-None-Match", ""):
        return response(HTTPStatus.NOT_MODIFIED, b"", kind, more)
    if "gzip" in asked.get("Accept-Encoding", "") and len(packed) < len(data):
        return response(HTTPStatus.OK, packed, kind, {**more, "Content-Encoding": "gzip"})
    return response(HTTPStatus.OK, data, kind, more)


@functools.lru_cache(maxsize=128)
def _read(file: Path, changed_ns: int) -> tuple[bytes, bytes, str]:
    """Return a file's bytes, the same packed, and their tag, anew once it has changed."""
    data = file.read_bytes()
    return data, gzip.compress(data, mtime=0), f'W/"{hashlib.sha256(data).hexdigest()[:16]}"'


def response(
    status: HTTPStatus, body: bytes | str, type: str = "text/plain", more: Mapping[str, str] | None = None
) -> Response:
    """Make an answer that ends the connection, with ``more`` headers."""
    data = body.encode() if isinstance(body, str) else body
    charset = "; charset=utf-8" if type.startswith("text/") else ""
    headers = Headers({**HEADERS, **(more or {})})
    headers["Date"] = email.utils.formatdate(usegmt=True)
    headers["Content-Type"] = f"{type}{charset}"
    headers["Content-Length"] = str(len(data))
    return Response(status.value, status.phrase, headers, data)
