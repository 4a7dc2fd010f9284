"""An HTTP server for tests that cuts connections, lies, stalls and changes its mind; and a data set that it serves."""

import hashlib
import http.server
import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bufgym.traces.datasets.download import Patience
from bufgym.traces.datasets.fetch import Fetched, fetch_dataset
from bufgym.traces.datasets.table import Dataset, Remote

DATA = random.Random(1).randbytes(300_000)
SHA256 = hashlib.sha256(DATA).hexdigest()
HASTY = Patience(attempts=3, first_wait_s=0.01)
ELSEWHERE = {"/moved": "/data.bin", "/file": "file:///etc/hostname", "/nowhere": "http://a..b/"}


@dataclass
class Site:
    """How the server answers requests of `/data.bin`, and which it got."""

    data: bytes = DATA
    etag: str | None = '"v1"'
    ranges: bool = True
    cuts: list[int] = field(default_factory=list)  # bytes after which each of the next connections is cut
    codes: list[int] = field(default_factory=list)  # answers to the next requests, instead of the file
    stall: int | None = None  # silent after so many bytes
    length: int | None = None  # Content-Length instead of the true one; -1: none
    chunked: bool = False
    headers: dict[str, str] = field(default_factory=dict)
    asked: list[str | None] = field(default_factory=list)  # the Range of each request
    address: str = ""
    closing: threading.Event = field(default_factory=threading.Event)


class Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    site: Site

    def log_message(self, format: str, *args: object) -> None: ...

    def do_GET(self) -> None:
        site = self.site
        self.close_connection = True
        if self.path in ELSEWHERE:
            return self.answer(302, {"Location": ELSEWHERE[self.path], "Content-Length": "0"})
        if self.path != "/data.bin":
            return self.answer(404, {"Content-Length": "0"})
        asked = self.headers["Range"]
        site.asked.append(asked)
        if site.codes:
            return self.answer(site.codes.pop(0), {"Retry-After": "0", "Content-Length": "0"})
        start = 0
        if asked and site.ranges and self.headers["If-Range"] in (site.etag, site.headers.get("Last-Modified")):
            start = int(asked.removeprefix("bytes=").removesuffix("-"))
            if start >= len(site.data):
                return self.answer(416, {"Content-Range": f"bytes */{len(site.data)}"})
        body = site.data[start:]
        headers = {"Content-Range": f"bytes {start}-{len(site.data) - 1}/{len(site.data)}"} if start else {}
        if site.chunked:
            headers["Transfer-Encoding"] = "chunked"
        elif site.length != -1:
            headers["Content-Length"] = str(len(body) if site.length is None else site.length)
        if site.etag is not None:
            headers["ETag"] = site.etag
        self.answer(206 if start else 200, headers | site.headers)
        self.body(body[: site.cuts.pop(0)] if site.cuts else body)

    def body(self, body: bytes) -> None:
        site = self.site
        if site.chunked:
            whole = len(body) == len(site.data)
            self.wfile.write(b"%x\r\n%s\r\n0\r\n\r\n" % (len(body), body) if whole else b"fffff\r\n" + body)
        elif site.stall is not None:
            self.wfile.write(body[: site.stall])
            site.closing.wait(60)
        else:
            self.wfile.write(body)

    def answer(self, code: int, headers: dict[str, str]) -> None:
        self.send_response(code)
        for name, value in {"Connection": "close", **headers}.items():
            self.send_header(name, value)
        self.end_headers()


@contextmanager
def serving() -> Iterator[Site]:
    """A site on a free port of this machine."""
    site = Site()
    handler = type("SiteHandler", (Handler,), {"site": site})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        server.daemon_threads = True
        site.address = f"http://127.0.0.1:{server.server_port}"
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield site
        site.closing.set()
        server.shutdown()
        thread.join()


def of(*remotes: Remote) -> Dataset:
    return Dataset("mine", "My data", "noise", "none", "https://example.org/", None, "nobody", remotes)


def get(site: Site, to: Path, sha256: str | None = SHA256, path: str = "data.bin", **options: Any) -> Fetched:
    remote = Remote(path, f"{site.address}/data.bin", sha256)
    return fetch_dataset(of(remote), to, patience=options.pop("patience", HASTY), **options)[0]


def left(to: Path) -> list[str]:
    """Names of the data set's files, hidden ones too."""
    return sorted(path.name for path in (to / "mine").iterdir())
