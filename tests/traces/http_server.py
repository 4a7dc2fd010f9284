"""An HTTP server for tests that cuts connections, lies and stalls; and a data set that it serves."""

import hashlib
import http.server
import random
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from bufgym.traces.datasets.fetch import Fetched, fetch_dataset
from bufgym.traces.datasets.table import Dataset, Remote

DATA = random.Random(1).randbytes(300_000)
SHA256 = hashlib.sha256(DATA).hexdigest()
ELSEWHERE = {"/moved": "/data.bin", "/file": "file:///etc/hostname", "/nowhere": "http://a..b/"}


@dataclass
class Site:
    """How the server answers requests of `/data.bin`, and how many it got."""

    data: bytes = DATA
    cuts: list[int] = field(default_factory=list)  # bytes after which each of the next connections is cut
    codes: list[int] = field(default_factory=list)  # answers to the next requests, instead of the file
    stall: int | None = None  # silent after so many bytes
    length: int | None = None  # Content-Length instead of the true one; -1: none
    asked: int = 0
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
        site.asked += 1
        if site.codes:
            return self.answer(site.codes.pop(0), {"Content-Length": "0"})
        length = len(site.data) if site.length is None else site.length
        self.answer(200, {} if length < 0 else {"Content-Length": str(length)})
        self.wfile.write(site.data[: site.cuts.pop(0) if site.cuts else site.stall])
        if site.stall is not None:
            site.closing.wait(60)

    def answer(self, code: int, headers: dict[str, str]) -> None:
        self.send_response(code)
        for name, value in {"Connection": "close", **headers}.items():
            self.send_header(name, value)
        self.end_headers()


@contextmanager
def serving() -> Iterator[Site]:
    """A site on a free port of this machine."""
    site = Site()
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), type("SiteHandler", (Handler,), {"site": site})) as server:
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
    address = options.pop("address", f"{site.address}/data.bin")
    return fetch_dataset(of(Remote(path, address, sha256)), to, **options)[0]


def left(to: Path) -> list[str]:
    """Names of the data set's files, hidden ones too."""
    return sorted(path.name for path in (to / "mine").iterdir())
