"""Public data sets in the cache folder, fetched by several at once or by hand; their table, and the command."""

import gzip
import hashlib
import re
import shutil
import threading
import zipfile
from pathlib import Path

import pytest
from cli_cases import Capsys, Patch, fails, shown
from http_server import DATA, SHA256, Site, get, left, of

from bufgym.cli import main
from bufgym.ground.errors import BufgymError
from bufgym.traces.datasets import Remote, cache_folder, datasets, fetch_dataset, table


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
        with pytest.raises(BufgymError, match=says):
            fetch_dataset(dataset, tmp_path / "other", [tmp_path / name])
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
    assert datasets()["belgium-4g"].licence is None


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
    assert all(name in out for name in datasets()) and "not known" in out
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
