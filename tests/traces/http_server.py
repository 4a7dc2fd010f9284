"""An HTTP server for tests that cuts connections, lies, stalls and changes its mind; and a data set that it serves."""

from __future__ import annotations

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
HASTY = Patience(attempts=3, first_wait_s=0.01, silence_s=0.3)


@dataclass
class Site:
    """What the server does with requests of `/data.bin`, and what it was asked."""

    data: bytes = DATA
    etag: str | None = '"v1"'
    ranges: bool = True
    cuts: list[int] = field(default_factory=list)
    """Bytes after which each of the next connections is cut."""
    codes: list[int] = field(default_factory=list)
    """Answers to the next requests, instead of the file."""
    stall: bool = False
    """Silent after the first 1000 bytes."""
    drip: tuple[int, float] | None = None
    """Bytes at a time, and seconds between them."""
    length: int | None = None
    """What Content-Length says instead of the truth; -1: nothing."""
    chunked: bool = False
    headers: dict[str, str] = field(default_factory=dict)
    asked: list[str | None] = field(default_factory=list)
    """The Range of each request."""
    address: str = ""
    closing: threading.Event = field(default_factory=threading.Event)


class Handler(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    site: Site

    def log_message(self, format: str, *args: object) -> None: ...

    def do_GET(self) -> None:
        site = self.site
        self.close_connection = True
        if self.path == "/moved":
            return self.answer(302, {"Location": "/data.bin"})
        if self.path == "/file":
            return self.answer(302, {"Location": "file:///etc/hostname"})
        if self.path == "/nowhere":
            return self.answer(302, {"Location": "http://a..b/"})
        if self.path != "/data.bin":
            return self.answer(404, {})
        asked = self.headers["Range"]
        site.asked.append(asked)
        if site.codes:
            return self.answer(site.codes.pop(0), {"Retry-After": "0"})
        start = 0
        if asked and site.ranges and self.headers["If-Range"] in (site.etag, site.headers.get("Last-Modified")):
            start = int(asked.removeprefix("bytes=").removesuffix("-"))
            if start >= len(site.data):
                return self.answer(416, {"Content-Range": f"bytes */{len(site.data)}"})
        self.send_response(206 if start else 200)
        body = site.data[start:]
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(site.data) - 1}/{len(site.data)}")
        if site.chunked:
            self.send_header("Transfer-Encoding", "chunked")
        elif site.length != -1:
            self.send_header("Content-Length", str(len(body) if site.length is None else site.length))
        for name, value in {"ETag": site.etag, "Connection": "close", **site.headers}.items():
            if value is not None:
                self.send_header(name, value)
        self.end_headers()
        self.body(body[: site.cuts.pop(0)] if site.cuts else body)

    def body(self, body: bytes) -> None:
        site = self.site
        if site.chunked:
            self.wfile.write(
                b"%x\r\n%s\r\n" % (len(body), body) if len(body) == len(site.data) else b"fffff\r\n" + body
            )
            self.wfile.write(b"0\r\n\r\n" if len(body) == len(site.data) else b"")
        elif site.stall:
            self.wfile.write(body[:1000])
            site.closing.wait(5)
        elif site.drip is not None:
            count, wait_s = site.drip
            for at in range(0, len(body), count):
                try:
                    self.wfile.write(body[at : at + count])
                except OSError:
                    return  # the client was killed
                site.closing.wait(wait_s)
        else:
            self.wfile.write(body)

    def answer(self, code: int, headers: dict[str, str]) -> None:
        self.send_response(code)
        for name, value in {"Content-Length": "0", "Connection": "close", **headers}.items():
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
    return fetch_dataset(of(remote), to, patience=HASTY, **options)[0]


def left(to: Path) -> list[str]:
    """Names of the data set's files, hidden ones too."""
    return sorted(path.name for path in (to / "mine").iterdir())
