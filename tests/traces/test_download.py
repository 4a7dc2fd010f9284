"""Files fetched over a network: whole and checked against their sum, or not kept and one sentence."""

import errno
import os
import shutil
import socket
from pathlib import Path
from typing import Any

import pytest
from http_server import DATA, SHA256, Site, get, left
from refusal_cases import refuse
from requests import PreparedRequest, Response

from bufgym.ground.errors import BufgymError
from bufgym.traces.datasets import Fetched, fetch


def test_a_whole_file(site: Site, tmp_path: Path) -> None:
    mask = os.umask(0o022)
    try:
        done = get(site, tmp_path)
    finally:
        os.umask(mask)
    assert done == Fetched(tmp_path / "mine" / "data.bin", SHA256, True, "downloaded")
    assert done.path.read_bytes() == DATA and done.path.stat().st_mode & 0o777 == 0o644
    assert left(tmp_path) == ["data.bin"]
    assert get(site, tmp_path).origin == "there already" and site.asked == 1  # the second time, nobody asked
    assert (get(site, tmp_path, None).sha256, get(site, tmp_path, None).known) == (SHA256, False)
    done.path.write_bytes(b"scribble")
    said: list[str] = []
    assert get(site, tmp_path, note=said.append).path.read_bytes() == DATA
    assert "changed since it was fetched" in said[0]
    (tmp_path / ".mine.part").mkdir()
    (tmp_path / ".mine.part" / "tmpabc").write_text("of a process that was killed")
    done.path.unlink()
    refuse(f"data.bin: SHA256 hash .* expected {'0' * 64} but got {SHA256}; not kept", get, site, tmp_path, "0" * 64)
    assert left(tmp_path) == [] and not (tmp_path / ".mine.part").exists()


@pytest.mark.parametrize(
    ("settings", "attempts"), [({"cuts": [100_000, 50_000]}, 3), ({"codes": [500, 429]}, 3), ({"length": -1}, 1)]
)
def test_what_goes_on(site: Site, tmp_path: Path, settings: dict[str, Any], attempts: int) -> None:
    vars(site).update(settings)
    assert get(site, tmp_path).path.read_bytes() == DATA
    assert site.asked == attempts and left(tmp_path) == ["data.bin"]


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"codes": [403] * 3}, r"the server says 403 Client Error: Forbidden$"),
        ({"length": 301_000}, r"it broke off \(.*300000 bytes read, 1000 more expected"),
        ({"data": b"\n<!DOCTYPE html><title>Please log in</title>"}, "data.bin: is an HTML page, not data"),
        ({"cuts": [1000] * 3}, r"it broke off \(.*1000 bytes read"),
        ({"stall": 1000}, r"it broke off \(.*Read timed out|the server does not respond$"),
        ({"address": "/nothing"}, r"/nothing: no such file on the server \(404\)"),
        ({"address": "/file"}, "No connection adapters .* 'file:///etc/hostname'"),
        ({"address": "/nowhere"}, "Failed to parse: .*a..b"),
        ({"address": "http://127.0.0.1:1/"}, "no network, no such server, or it broke off .*refused"),
    ],
)
def test_what_does_not(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any], says: str
) -> None:
    monkeypatch.setattr(fetch, "SILENCE_S", 0.3 if "stall" in settings else 30)
    address = settings.pop("address", "/data.bin")
    vars(site).update(settings)
    refuse(says, get, site, tmp_path, None, address=address if address.startswith("http") else site.address + address)
    assert left(tmp_path) == []


def test_redirections_and_names(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert get(site, tmp_path, address=f"{site.address}/moved").path.read_bytes() == DATA
    response = Response()
    response.status_code, response.url, response.request = 302, "https://a/", PreparedRequest()
    response.headers["Location"] = "http://b/"
    refuse("https://a/: redirects to http://b/, which is not allowed", fetch._refuse_plain, response)

    def unresolved(*arguments: object, **options: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unresolved)
    monkeypatch.setenv("no_proxy", "*")
    with pytest.raises(BufgymError, match=r"http://data\.example/x: no network, no such server, .*Name or service"):
        get(site, tmp_path / "other", address="http://data.example/x")


def test_a_full_disk_and_a_file_without_end(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(fetch, "MAX_BYTES", 200_000)
        refuse("sends more than 200000 bytes: must be less", get, site, tmp_path)

    def full(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(shutil, "move", full)
    refuse("cannot be written to the disk: No space left on device", get, site, tmp_path)
    assert left(tmp_path) == []
