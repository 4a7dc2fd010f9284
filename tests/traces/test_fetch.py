"""Public data sets in the cache folder, fetched by several at once or by hand; their table, command and archives."""

import errno
import gzip
import hashlib
import io
import os
import random
import re
import shutil
import stat
import struct
import tarfile
import threading
import zipfile
from pathlib import Path
from typing import Any

import pytest
from cli_cases import Capsys, Patch, fails, shown
from http_server import DATA, SHA256, Site, get, left, of
from recording_cases import RECORDINGS
from refusal_cases import refuse
from requests import PreparedRequest, Response

from bufgym.cli import main
from bufgym.traces.datasets import fetch, table
from bufgym.traces.datasets import unpack as unpacking
from bufgym.traces.datasets.fetch import Fetched, cache_folder, fetch_dataset
from bufgym.traces.datasets.table import Remote, datasets
from bufgym.traces.datasets.unpack import unpack
from bufgym.utils.errors import BufgymError


def test_two_at_once_fetch_once(site: Site, tmp_path: Path) -> None:
    begun, waiting, origins = threading.Event(), threading.Event(), []

    def downloading(sentence: str) -> None:
        begun.set()
        assert waiting.wait(60)

    first = threading.Thread(target=lambda: origins.append(get(site, tmp_path, note=downloading).origin))
    first.start()
    assert begun.wait(60)
    origins.append(get(site, tmp_path, note=lambda sentence: waiting.set()).origin)
    first.join()
    assert sorted(origins) == ["downloaded", "there already"] and site.asked == 1


def test_from_a_file(tmp_path: Path) -> None:
    dataset = of(Remote("a.bin", "http://x/a.bin", SHA256), Remote("sub/b.bin", "http://x/b.bin"))
    (tmp_path / "download (1)").write_bytes(DATA)
    (tmp_path / "b.bin").write_bytes(b"1 2")
    renamed, known = fetch_dataset(dataset, tmp_path / "to", [tmp_path / "download (1)", tmp_path / "b.bin"])
    assert (renamed.path.name, renamed.known, renamed.origin) == ("a.bin", True, "copied")  # known by its sum
    assert (known.path, known.known) == (tmp_path / "to" / "mine" / "sub" / "b.bin", False)
    assert renamed.path.read_bytes() == DATA and known.path.read_bytes() == b"1 2"
    for name, content, says in (
        ("a.bin", b"other", "a.bin: wrong checksum: sha256 is [0-9a-f]{64}, must be " + SHA256),
        ("c.bin", b"other", r"c.bin: no file of mine, by its name or its checksum .*: a.bin, sub/b"),
        ("b.bin", b"<html>", "is an HTML page"),
        ("d.bin", None, r"no such file \(--from\)"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        refuse(says, fetch_dataset, dataset, tmp_path / "other", [tmp_path / name])
        assert left(tmp_path / "other") == []
    with pytest.raises(BufgymError, match=r"ucc-4g: the address .* not known: fetch them by hand from https://www.ucc"):
        fetch_dataset("ucc-4g", tmp_path)
    with zipfile.ZipFile(tmp_path / "4G.zip", "w") as archive:
        archive.writestr("bus/a.csv", "x")
    done = fetch_dataset("ucc-4g", tmp_path / "to", [tmp_path / "4G.zip"])[0]
    assert done.unpacked == tmp_path / "to" / "ucc-4g" / "4G"
    assert (done.unpacked / "bus" / "a.csv").read_text() == "x"


def test_an_archive_is_unpacked_beside_itself(site: Site, tmp_path: Path) -> None:
    with pytest.raises(BufgymError, match=r"logs.zip: damaged, cut off, or no .zip archive"):
        get(site, tmp_path, None, path="logs.zip")  # nothing vouches for it, so it must unpack
    assert left(tmp_path) == []
    for text in (b"old", b"new"):
        with zipfile.ZipFile(tmp_path / "made.zip", "w") as archive:
            archive.writestr("log.txt", text)
        site.data = (tmp_path / "made.zip").read_bytes()
        sum_now = hashlib.sha256(site.data).hexdigest()
        done = get(site, tmp_path, sum_now, path="logs.zip")
        assert done.unpacked is not None and (done.unpacked / "log.txt").read_bytes() == text
    assert left(tmp_path) == ["logs", "logs.zip"]
    shutil.rmtree(done.unpacked)
    assert get(site, tmp_path, sum_now, path="logs.zip").unpacked == done.unpacked
    assert (done.unpacked / "log.txt").exists() and site.asked == 3


def test_the_table_says_what_is_known() -> None:
    listed = [f"{dataset.name}/{remote.path}" for dataset in datasets().values() for remote in dataset.files]
    assert len(listed) == len(set(listed)) and set(table.checksums()) <= set(listed)
    for dataset in datasets().values():
        assert dataset.page.startswith("https://") and dataset.citation and dataset.title
        for remote in dataset.files:
            assert remote.address.startswith("https://") and not {"..", ""} & set(remote.path.split("/"))
            assert remote.sha256 is None or re.fullmatch("[0-9a-f]{64}", remote.sha256)
            if "githubusercontent" in remote.address:
                assert re.search("/[0-9a-f]{40}/", remote.address)  # a commit, not a branch that moves


def test_the_sums_are_those_of_the_recordings_of_the_tests() -> None:
    """So whoever fetches them has the very same files."""
    files = {path.relative_to(RECORDINGS).as_posix(): path for path in RECORDINGS.glob("*/*") if path.name != "LICENSE"}
    sums = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in files.items()}
    assert sums == {name: table.checksums().get(name) for name in files} != {}


@pytest.mark.nightly
def test_the_sums_are_those_of_the_recorded_files(shared_data: Path, tmp_path: Path) -> None:
    assert fetch_dataset("ucc-5g", tmp_path, [shared_data / "ucc_5g" / "5G-production-dataset.zip"])[0].known
    logs = sorted((tmp_path / "ucc-5g").rglob("Download/**/*.csv"))
    assert len(logs) > 0 and b"DL_bitrate" in logs[0].read_bytes()[:400]
    for name, folder in (("perama-wifi", "uplink_wifi"), ("mmwave-uplink", "uplink_mmwave")):
        known = {remote.path.replace("/", "_"): remote.sha256 for remote in datasets()[name].files}
        for path in sorted((shared_data / folder).glob("*.gz")):
            assert hashlib.sha256(gzip.decompress(path.read_bytes())).hexdigest() == known.pop(path.stem)
        assert not known


def test_the_command_lists_fetches_and_refuses(site: Site, tmp_path: Path, monkeypatch: Patch, capsys: Capsys) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert cache_folder().parts[-3:] == ("cache", "bufgym", "datasets")
    out = shown(["trace", "fetch", "--list"], capsys)
    assert not [name for name in datasets() if name not in out] and "not known" in out
    out = shown(["trace", "fetch", "tum-rgbd", "--list"], capsys)
    assert re.search("freiburg1_desk2-groundtruth.txt +sha256 not known", out) and "CC BY 4.0" in out
    monkeypatch.setitem(datasets(), "mine", of(Remote("data.bin", f"{site.address}/data.bin")))
    assert main(["trace", "fetch", "mine"]) == 0
    said = capsys.readouterr()
    assert f"{SHA256}  data.bin (none known)" in said.out
    assert re.search("licence +not known", said.out) and re.search("please cite +nobody", said.out)
    assert said.err == f"downloading {site.address}/data.bin\n"
    assert (cache_folder() / "mine" / "data.bin").read_bytes() == DATA
    for words, says in (
        ("", "needs the NAME of a data set (--list names them)"),
        ("belgium", "belgium: no such data set: must be one of belgium-4g"),
        ("ucc-4g", "address of its files is not known"),
        ("ucc-5g --from nowhere.zip", "nowhere.zip: no such file"),
    ):
        fails(["trace", "fetch", *words.split()], says, capsys)


# Files fetched over a network: whole and checked against their sum, or not kept and one sentence.


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


def test_a_full_disk_and_a_file_without_end(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(fetch, "MAX_BYTES", 200_000)
        refuse("sends more than 200000 bytes: must be less", get, site, tmp_path)

    def full(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(shutil, "move", full)
    refuse("cannot be written to the disk: No space left on device", get, site, tmp_path)
    assert left(tmp_path) == []


NOISE = random.Random(1).randbytes(300_000)
Members = dict[str, str | bytes]


def zipped(path: Path, contents: Members) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in contents.items():
            archive.writestr(name, data)
    return path


def tarred(path: Path, *contents: tuple[str, bytes], kind: bytes = tarfile.REGTYPE) -> Path:
    with tarfile.open(path, "w:gz") as archive:
        for name, content in contents:
            info = tarfile.TarInfo(name)
            info.size, info.type, info.linkname = len(content), kind, "elsewhere"
            archive.addfile(info, io.BytesIO(content))
    return path


def test_archives_unpack(tmp_path: Path) -> None:
    contents = [("top/log.txt", b"1 2\n"), ("top/deep/er.bin", NOISE)]
    packed = [tarred(tmp_path / name, *contents) for name in ("a.tgz", "a.tar.gz")]
    for archive in (zipped(tmp_path / "a.zip", {**dict(contents), "__MACOSX/top/._log.txt": b"junk"}), *packed):
        out = tmp_path / f"{archive.name}.out"
        unpack(archive, out)
        assert {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*.*")} == dict(contents)


@pytest.mark.parametrize("name", ["../out.txt", "/tmp/out.txt", "a/../../out.txt", "C:out.txt", "a\\..\\out.txt"])
@pytest.mark.parametrize("kind", ["zip", "tgz"])
def test_no_way_out_of_the_folder(tmp_path: Path, kind: str, name: str) -> None:
    path, contents = tmp_path / f"a.{kind}", {"fine.txt": b"x", name: b"x"}
    archive = zipped(path, {**contents}) if kind == "zip" else tarred(path, *contents.items())
    refuse(f"member = .*{re.escape(name[-7:])}.*: leads out of its folder", unpack, archive, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == [archive.name]


def test_what_is_no_file_comes_twice_or_is_too_much_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(archive: Path, says: str) -> None:
        refuse(says, unpack, archive, tmp_path / "out", 10**6)
        archive.unlink()
        assert list(tmp_path.iterdir()) == []

    tgz, path = tmp_path / "a.tgz", tmp_path / "a.zip"
    for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.FIFOTYPE):
        refused(tarred(tgz, ("link", b""), kind=kind), "member = link: must be a plain file")
    link = zipfile.ZipInfo("link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(link, "/etc/passwd")
    refused(path, "member = link: must be a plain file")
    refused(tarred(tgz, ("twin", b"1"), ("twin", b"2")), "member = twin: must come only once")
    path.write_bytes(zipped(path, {"nul": b"1"}).read_bytes().replace(b"nul", b"\0ul"))
    refused(path, r"damaged, cut off, or no \.zip archive")
    refused(zipped(path, {}), "holds no file")
    refused(zipped(path, {"zeros": bytes(1_000_001)}), "unpacks to more than 1000000 bytes")
    # The size that the zip's directory states, made smaller: the copying counts for itself.
    raw = zipped(path, {"zeros": bytes(1_000_001)}).read_bytes()
    path.write_bytes(raw.replace(struct.pack("<I", 1_000_001), struct.pack("<I", 10)))
    refused(path, r"unpacks to more|damaged")
    halves = tarred(tgz, ("first", bytes(600_000)), ("second", bytes(600_000)))
    refused(halves, r"member = second: unpacks to more than 1000000 bytes")
    # tarfile would read an extended header of any announced length into memory.
    info = tarfile.TarInfo("x")
    info.type, info.size = tarfile.XHDTYPE, 2**31
    tgz.write_bytes(gzip.compress(info.tobuf(tarfile.USTAR_FORMAT) + bytes(10_240)))
    refused(tgz, "a header of 2147483648 bytes: must be at most")
    monkeypatch.setattr(unpacking, "MAX_MEMBERS", 3)
    refused(zipped(path, {f"{k}": b"" for k in range(4)}), "or 3 files: must be less")
    refused(tarred(tgz, *((f"{k}", b"") for k in range(4))), "or 3 files: must be less")
