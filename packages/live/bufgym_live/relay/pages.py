"""The relay's page over HTTP on the same port; it serves the files of one folder and nothing else."""

import email.utils
import mimetypes
from http import HTTPStatus
from pathlib import Path
from typing import Final

from websockets.datastructures import Headers
from websockets.http11 import Response

FOLDER: Final = Path(__file__).with_name("page")
HEADERS: Final = {
    "Cache-Control": "no-cache",
    "Connection": "close",
    "Content-Security-Policy": (
        "default-src 'self'; script-src 'self' 'unsafe-inline'; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' data: blob:; connect-src 'self' ws: wss:; frame-ancestors 'none'; base-uri 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


def answer(path: str, folder: Path = FOLDER) -> Response:
    """Answer a GET of this path."""
    name = path.partition("?")[0].removeprefix("/") or "index.html"
    files = {file.name: file for file in folder.iterdir() if file.is_file()} if folder.is_dir() else {}
    if name not in files:  # a name that was not listed is never opened: no "..", no absolute path
        return response(HTTPStatus.NOT_FOUND, "no such page\n")
    return response(HTTPStatus.OK, files[name].read_bytes(), mimetypes.guess_type(name)[0] or "text/plain")


def response(status: HTTPStatus, body: bytes | str, type: str = "text/plain") -> Response:
    """Make an answer that ends the connection."""
    data = body.encode() if isinstance(body, str) else body
    charset = "; charset=utf-8" if type.startswith("text/") else ""
    headers = Headers(HEADERS)
    headers["Date"] = email.utils.formatdate(usegmt=True)
    headers["Content-Type"] = f"{type}{charset}"
    headers["Content-Length"] = str(len(data))
    return Response(status.value, status.phrase, headers, data)
