"""Files fetched over a network: resumed where they were cut, checked against their sum, never patched together."""

import errno
import hashlib
import io
import os
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request

import pytest
from http_server import DATA, HASTY, SHA256, Site, get, left

from bufgym.ground.errors import BufgymError
from bufgym.traces.datasets import connection
from bufgym.traces.datasets import download as downloading
from bufgym.traces.datasets.download import Patience, download
from bufgym.traces.datasets.fetch import Fetched


def test_a_whole_file(site: Site, tmp_path: Path) -> None:
    heard: list[tuple[int, int | None]] = []
    mask = os.umask(0o022)
    try:
        done = get(site, tmp_path, watch=lambda name: lambda count, total: heard.append((count, total)))
    finally:
        os.umask(mask)
    assert done == Fetched(tmp_path / "mine" / "data.bin", SHA256, True, "downloaded")
    assert done.path.read_bytes() == DATA and done.path.stat().st_mode & 0o777 == 0o644
    assert heard[-1] == (300_000, 300_000) and heard == sorted(heard)
    assert left(tmp_path) == ["data.bin"]
    assert get(site, tmp_path).origin == "there already" and site.asked == [None]  # the second time, nobody asked
    assert (get(site, tmp_path, None).sha256, get(site, tmp_path, None).known) == (SHA256, False)
    done.path.write_bytes(b"scribble")
    said: list[str] = []
    assert get(site, tmp_path, note=said.append).path.read_bytes() == DATA
    assert "changed since it was fetched" in said[0]
    done.path.unlink()
    with pytest.raises(BufgymError, match=f"wrong checksum: sha256 is {SHA256}, must be {'0' * 64}; not kept"):
        get(site, tmp_path, "0" * 64)
    assert left(tmp_path) == []


ATAD = DATA[::-1]
DATED = {"Last-Modified": "Sat, 29 Feb 2020 09:36:00 GMT"}


@pytest.mark.parametrize(
    ("settings", "asked"),
    [
        ({"cuts": [100_000, 50_000]}, [None, "bytes=100000-", "bytes=150000-"]),
        # Ten connections of 30,000 bytes each, with patience for three: headway is no failure.
        ({"cuts": [30_000] * 9}, [None] + [f"bytes={30_000 * k}-" for k in range(1, 10)]),
        # A server without ranges starts anew, and one that names no version is asked to.
        ({"ranges": False, "cuts": [200_000]}, [None, "bytes=200000-"]),
        ({"etag": None, "cuts": [200_000]}, [None, None]),
        # A weak ETag vouches for the meaning and not for the bytes; a date is a version too.
        ({"etag": 'W/"v1"', "headers": DATED, "cuts": [1000]}, [None, "bytes=1000-"]),
        # The length of a file in chunks is not announced, yet that it was cut is noticed.
        ({"chunked": True, "ranges": False, "cuts": [1000]}, [None, "bytes=1000-"]),
        ({"codes": [500, 429]}, [None, None, None]),
        ({"length": -1}, [None]),
    ],
)
def test_what_goes_on(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any], asked: list[str | None]
) -> None:
    monkeypatch.setattr(downloading, "HEADWAY_BYTES", 30_000)
    vars(site).update(settings)
    assert get(site, tmp_path).path.read_bytes() == DATA
    assert site.asked == asked and left(tmp_path) == ["data.bin"]


@pytest.mark.parametrize(
    ("settings", "says", "attempts"),
    [
        ({"codes": [403, 200]}, r"the server says 403 Forbidden$", 1),
        ({"length": 299_000}, "sends more bytes than the 299000 announced", 1),
        ({"length": 301_000}, "cut after 300000 of 301000 bytes", 3),
        ({"data": b"\n<!DOCTYPE html><title>Please log in</title>"}, "is an HTML page, not data", 1),
        ({"headers": {"Content-Encoding": "gzip"}}, "comes with Content-Encoding gzip", 1),
        ({"cuts": [1000] * 3}, r"cut after 3000 of 300000 bytes \(gave up after 3 attempts\); 3000 bytes are kept", 3),
    ],
)
def test_what_does_not(site: Site, tmp_path: Path, settings: dict[str, Any], says: str, attempts: int) -> None:
    vars(site).update(settings)
    with pytest.raises(BufgymError, match=says):
        get(site, tmp_path, None)
    assert len(site.asked) == attempts and "data.bin" not in left(tmp_path)


def test_the_next_call_goes_on_unless_the_file_changed_meanwhile(site: Site, tmp_path: Path) -> None:
    for k, (etag, data, known) in enumerate(
        (('"v1"', DATA, True), ('"v2"', bytes(250_000), False), ('"v2"', bytes(250_000), True), ('"v1"', ATAD, True))
    ):
        site.cuts, site.data, site.etag, to = [1000] * 3, DATA, '"v1"', tmp_path / f"{k}"
        with pytest.raises(BufgymError, match="run the same command again to resume"):
            get(site, to, None)
        assert left(to) == [".data.bin.part", ".data.bin.part.json"]
        site.data, site.etag, site.asked, said = data, etag, [], []
        done = get(site, to, hashlib.sha256(data).hexdigest() if known else None, note=said.append)
        assert done.path.read_bytes() == data and left(to) == ["data.bin"] and "bytes=3000-" in site.asked
        # The server changed the file and kept its ETag: the sum tells.
        assert said == (["data.bin: the parts do not fit together: fetching it again"] if data is ATAD else [])


def test_addresses(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part = tmp_path / "part"
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    for address, says in {
        f"{site.address}/nothing": r"/nothing: no such file on the server \(404\)",
        f"{site.address}/file": "302 .*'file:///etc/hostname' is not allowed",
        f"{site.address}/nowhere": "redirects to an invalid address",
        "file:///etc/hostname": "must be an http or https address",
        f"http://127.0.0.1:{port}/": r"no connection \(Connection refused\) \(gave up after 3 attempts\)$",
    }.items():
        with pytest.raises(BufgymError, match=says):
            download(address, part, None, HASTY)
    redirected: Any = (Request("https://a/"), io.BytesIO(), 302, "Found", None, "http://b/")
    with pytest.raises(HTTPError, match="redirects to http://b/, which is not allowed") as caught:
        connection.SafeRedirects().redirect_request(*redirected)
    caught.value.close()
    download(f"{site.address}/moved", part, None, HASTY)
    assert part.read_bytes() == DATA

    def unresolved(*arguments: object, **options: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unresolved)
    monkeypatch.setenv("no_proxy", "*")
    with pytest.raises(BufgymError, match=r"no network, or no such host as data\.example"):
        download("http://data.example/x", part, None, HASTY)


def test_silence_and_a_full_disk(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(out: object, block: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(downloading, "_write", full)
        with pytest.raises(BufgymError, match="mine: the disk is full: make room and run the same command again"):
            get(site, tmp_path)
    usage = shutil.disk_usage(tmp_path)._replace(free=299_999)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda path: usage)
        with pytest.raises(BufgymError, match="the disk is full: 300000 bytes are needed, 299999 are free"):
            get(site, tmp_path)
    site.stall = 1000
    with pytest.raises(BufgymError, match=r"the server (fell silent|does not respond) \(gave up after 2 attempts\)"):
        get(site, tmp_path, patience=Patience(attempts=2, first_wait_s=0, silence_s=0.3))


@contextmanager
def speaking(talk: Callable[[socket.socket], None]) -> Iterator[str]:
    """The address of a server that says this to each client in turn, whatever it asks."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            with suppress(OSError):  # the server was shut down
                while True:
                    client, _ = server.accept()
                    with client, suppress(OSError):  # the client may have gone
                        client.recv(4096)
                        talk(client)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.getsockname()[1]}/"
        finally:
            server.shutdown(socket.SHUT_RDWR)
            thread.join()


ENDLESS = (
    (b"", b"HTTP/1.1 100 Continue\r\n\r\n" * 40),
    (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n1\r\nx\r\n0\r\n", b"More: and more\r\n" * 60),
)


@pytest.mark.parametrize("wait_s", [0.0, 0.02])
def test_headers_and_trailers_without_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wait_s: float) -> None:
    """As fast as they can, or never silent for long: the attempt ends by bytes, or by time."""
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(connection, "MAX_HEAD_BYTES", 10**5)
    for begin, more in ENDLESS:

        def talk(client: socket.socket, begin: bytes = begin, more: bytes = more) -> None:
            client.sendall(begin)
            while True:  # until the client has gone
                client.sendall(more)
                time.sleep(wait_s)

        with speaking(talk) as address, pytest.raises(BufgymError, match="gave up after 1 attempts"):
            download(address, tmp_path / "part", None, Patience(attempts=1, silence_s=0.2))
