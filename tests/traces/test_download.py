"""Files downloaded from a server that cuts connections, lies, stalls and changes its mind."""

from __future__ import annotations

import errno
import hashlib
import io
import random
import shutil
import socket
import threading
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from http_server import DATA, HASTY, SHA256, Site, get, left

from bufgym.errors import BufgymError
from bufgym.traces.datasets import download as downloading
from bufgym.traces.datasets.download import Patience, download
from bufgym.traces.datasets.fetch import Fetched


def test_a_whole_file(site: Site, tmp_path: Path) -> None:
    heard: list[tuple[int, int | None]] = []
    done = get(site, tmp_path, watch=lambda name: lambda count, total: heard.append((count, total)))
    assert done == Fetched(tmp_path / "mine" / "data.bin", SHA256, True, "downloaded")
    assert done.path.read_bytes() == DATA
    assert heard[-1] == (300_000, 300_000) and heard == sorted(heard)
    assert left(tmp_path) == ["data.bin"]
    assert get(site, tmp_path).origin == "there already"
    assert site.asked == [None]  # the second time, nobody asked


def test_a_cut_connection_goes_on_where_it_was(site: Site, tmp_path: Path) -> None:
    site.cuts = [100_000, 50_000]
    assert get(site, tmp_path).path.read_bytes() == DATA
    assert site.asked == [None, "bytes=100000-", "bytes=150000-"]


def test_the_next_call_goes_on_too(site: Site, tmp_path: Path) -> None:
    site.cuts = [1000, 1000, 1000]
    with pytest.raises(BufgymError, match=r"cut after 3000 of 300000 bytes \(gave up after 3 attempts\); 3000 bytes"):
        get(site, tmp_path)
    assert left(tmp_path) == [".data.bin.part", ".data.bin.part.json"]
    assert get(site, tmp_path).path.read_bytes() == DATA
    assert site.asked[-1] == "bytes=3000-"
    assert left(tmp_path) == ["data.bin"]


def test_headway_is_no_failure(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten cuts, thirty thousand bytes each, with patience for three."""
    monkeypatch.setattr(downloading, "HEADWAY_BYTES", 30_000)
    site.cuts = [30_000] * 9
    assert get(site, tmp_path).path.read_bytes() == DATA
    assert len(site.asked) == 10


def test_a_server_without_ranges_starts_anew(site: Site, tmp_path: Path) -> None:
    site.ranges = False
    site.cuts = [200_000]
    assert get(site, tmp_path).path.read_bytes() == DATA
    assert site.asked == [None, "bytes=200000-"]


def test_a_server_that_names_no_version_starts_anew(site: Site, tmp_path: Path) -> None:
    site.etag, site.cuts = None, [200_000]
    assert get(site, tmp_path).path.read_bytes() == DATA
    assert site.asked == [None, None]


def test_a_date_is_a_version_too(site: Site, tmp_path: Path) -> None:
    """A weak ETag vouches for the meaning and not for the bytes."""
    site.etag, site.headers = 'W/"v1"', {"Last-Modified": "Sat, 29 Feb 2020 09:36:00 GMT"}
    site.cuts = [1000]
    assert get(site, tmp_path).path.read_bytes() == DATA
    assert site.asked == [None, "bytes=1000-"]


def test_a_file_in_chunks(site: Site, tmp_path: Path) -> None:
    """Its length is not announced, yet that it was cut is noticed."""
    site.chunked, site.ranges = True, False
    site.cuts = [1000]
    assert get(site, tmp_path, None).path.read_bytes() == DATA
    assert site.asked == [None, "bytes=1000-"]


@pytest.mark.parametrize("sha256", [None, "new"])
def test_a_file_that_changed_meanwhile_is_not_patched_together(site: Site, tmp_path: Path, sha256: str | None) -> None:
    site.cuts = [1000] * 3
    with pytest.raises(BufgymError, match="run the same command again to resume"):
        get(site, tmp_path, None)
    site.data, site.etag = bytes(250_000), '"v2"'
    done = get(site, tmp_path, sha256 and hashlib.sha256(site.data).hexdigest())
    assert done.path.read_bytes() == site.data


def test_parts_that_do_not_fit_are_found_by_the_sum(site: Site, tmp_path: Path) -> None:
    """The server changes the file and keeps its ETag."""
    site.cuts = [1000] * 3
    with pytest.raises(BufgymError, match="run the same command again to resume"):
        get(site, tmp_path)
    site.data = DATA[::-1]
    said: list[str] = []
    done = get(site, tmp_path, hashlib.sha256(site.data).hexdigest(), note=said.append)
    assert done.path.read_bytes() == DATA[::-1]
    assert said == ["data.bin: the parts do not fit together: fetching it again"]


def test_a_wrong_sum_keeps_nothing(site: Site, tmp_path: Path) -> None:
    with pytest.raises(BufgymError, match=f"wrong checksum: sha256 is {SHA256}, must be {'0' * 64}; not kept"):
        get(site, tmp_path, "0" * 64)
    assert left(tmp_path) == []


def test_an_unknown_sum_is_found(site: Site, tmp_path: Path) -> None:
    done = get(site, tmp_path, None)
    assert (done.sha256, done.known) == (SHA256, False)


def test_a_damaged_cache_is_renewed(site: Site, tmp_path: Path) -> None:
    get(site, tmp_path).path.write_bytes(b"scribble")
    said: list[str] = []
    assert get(site, tmp_path, note=said.append).path.read_bytes() == DATA
    assert "changed since it was fetched" in said[0]


def test_slow_bytes_are_waited_for(site: Site, tmp_path: Path) -> None:
    """Half a second in all, more than the 0.3 s of silence that are allowed."""
    site.data, site.drip = DATA[:1000], (20, 0.01)
    assert get(site, tmp_path, None).path.read_bytes() == DATA[:1000]
    assert len(site.asked) == 1


def test_silence_is_not(site: Site, tmp_path: Path) -> None:
    site.stall = True
    with pytest.raises(BufgymError, match=r"the server fell silent \(gave up after 3 attempts\); 3000 bytes are kept"):
        get(site, tmp_path)
    assert site.asked == [None, "bytes=1000-", "bytes=2000-"]


def test_errors_that_pass_and_errors_that_stay(site: Site, tmp_path: Path) -> None:
    site.codes = [500, 429]
    assert get(site, tmp_path).path.read_bytes() == DATA
    site.codes = [503] * 3
    with pytest.raises(BufgymError, match=r"the server says 503 Service Unavailable \(gave up after 3 attempts\)$"):
        get(site, tmp_path, path="other.bin")
    site.codes = [403, 200]
    with pytest.raises(BufgymError, match=r"the server says 403 Forbidden$"):
        get(site, tmp_path, path="other.bin")
    assert site.codes == [200]  # no second attempt


@pytest.mark.parametrize(
    ("path", "says"),
    [
        ("/nothing", r"/nothing: no such file on the server \(404\)"),
        ("/file", "302 .*'file:///etc/hostname' is not allowed"),
        ("/nowhere", "redirects to an invalid address"),
    ],
)
def test_addresses_that_lead_nowhere(site: Site, tmp_path: Path, path: str, says: str) -> None:
    with pytest.raises(BufgymError, match=says):
        download(site.address + path, tmp_path / "part", None, HASTY)
    with pytest.raises(BufgymError, match="must be an http or https address"):
        download("file:///etc/hostname", tmp_path / "part")


def test_a_redirection_is_followed(site: Site, tmp_path: Path) -> None:
    download(f"{site.address}/moved", tmp_path / "part", None, HASTY)
    assert (tmp_path / "part").read_bytes() == DATA


def test_no_way_back_from_https_to_http() -> None:
    from urllib.error import HTTPError
    from urllib.request import Request

    from bufgym.traces.datasets.connection import SafeRedirects

    nothing: Any = None
    with pytest.raises(HTTPError, match="redirects to http://b/, which is not allowed") as caught:
        SafeRedirects().redirect_request(Request("https://a/"), io.BytesIO(), 302, "Found", nothing, "http://b/")
    caught.value.close()


def test_more_or_less_than_announced(site: Site, tmp_path: Path) -> None:
    site.length = 299_000
    with pytest.raises(BufgymError, match="sends more bytes than the 299000 announced"):
        get(site, tmp_path, None)
    site.length = 301_000
    with pytest.raises(BufgymError, match="cut after 300000 of 301000 bytes"):
        get(site, tmp_path, None)
    site.length = -1
    assert get(site, tmp_path).path.read_bytes() == DATA


def test_a_page_is_no_data(site: Site, tmp_path: Path) -> None:
    site.data = b"\n<!DOCTYPE html><title>Please log in</title>"
    with pytest.raises(BufgymError, match="is an HTML page, not data"):
        get(site, tmp_path, None)
    site.data, site.headers = DATA, {"Content-Type": "text/html; charset=utf-8"}
    with pytest.raises(BufgymError, match="is an HTML page, not data"):
        get(site, tmp_path)
    site.headers = {"Content-Encoding": "gzip"}
    with pytest.raises(BufgymError, match="comes with Content-Encoding gzip"):
        get(site, tmp_path)
    assert left(tmp_path) == []


def test_an_empty_answer_is_no_file(site: Site, tmp_path: Path) -> None:
    site.data = b""
    with pytest.raises(BufgymError, match="the server sent nothing"):
        get(site, tmp_path, None)


def test_nobody_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "*")
    with socket.create_server(("127.0.0.1", 0)) as dequeued:
        port = dequeued.getsockname()[1]
    with pytest.raises(BufgymError, match=r"no connection \(Connection refused\) \(gave up after 3 attempts\)$"):
        download(f"http://127.0.0.1:{port}/", tmp_path / "part", None, HASTY)

    def unresolved(*arguments: object, **options: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unresolved)
    with pytest.raises(BufgymError, match=r"no network, or no such host as data\.example"):
        download("http://data.example/x", tmp_path / "part", None, HASTY)


def test_a_full_disk(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(out: object, block: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(downloading, "_write", full)
        with pytest.raises(BufgymError, match="mine: the disk is full: make room and run the same command again"):
            get(site, tmp_path)
    usage = shutil.disk_usage(tmp_path)._replace(free=299_999)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    with pytest.raises(BufgymError, match="the disk is full: 300000 bytes are needed, 299999 are free"):
        get(site, tmp_path)


def test_garbled_answers_end_in_a_file_or_our_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    whole = (
        b'HTTP/1.1 206 Partial Content\r\nContent-Length: 50\r\nETag: "v1"\r\nContent-Range: bytes 0-49/50\r\n'
        b"Content-Type: text/plain\r\nConnection: close\r\n\r\n" + DATA[:50]
    )
    dice, refused = random.Random(3), 0
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                with connection, suppress(OSError):  # the client may have gone
                    connection.recv(4096)
                    raw = bytearray(whole)
                    for _ in range(dice.randint(1, 5)):
                        raw[dice.randrange(len(whole) - 45)] = dice.randrange(256)
                    connection.sendall(raw)

        thread = threading.Thread(target=serve)
        thread.start()
        for _ in range(300):
            downloading.discard(tmp_path / "part")
            try:
                address = f"http://127.0.0.1:{server.getsockname()[1]}/"
                download(address, tmp_path / "part", None, Patience(attempts=2, first_wait_s=0, silence_s=0.5))
            except BufgymError as error:
                refused += 1
                assert str(error).isprintable()
        server.shutdown(socket.SHUT_RDWR)
        thread.join()
    assert 30 < refused < 300


ENDLESS = {
    "100 Continue": (b"", b"HTTP/1.1 100 Continue\r\n\r\n" * 40),
    "trailers": (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n1\r\nx\r\n0\r\n", b"More: and more\r\n" * 60),
}


@pytest.mark.parametrize("wait_s", [0.0, 0.05])
@pytest.mark.parametrize("kind", ENDLESS)
def test_headers_and_trailers_without_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, wait_s: float
) -> None:
    """As fast as they can, or never silent for long: the attempt ends by bytes, or by time."""
    from bufgym.traces.datasets import connection

    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(connection, "MAX_HEAD_BYTES", 10**5)
    first, again = ENDLESS[kind]
    stop = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            with suppress(OSError):
                while True:
                    client, _ = server.accept()
                    with client, suppress(OSError):
                        client.recv(4096)
                        client.sendall(first)
                        while not stop.wait(wait_s):
                            client.sendall(again)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        address = f"http://127.0.0.1:{server.getsockname()[1]}/"
        with pytest.raises(BufgymError, match="gave up after 1 attempts"):
            download(address, tmp_path / "part", None, Patience(attempts=1, silence_s=0.5))
        stop.set()
