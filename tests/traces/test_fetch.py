"""Public data sets in the cache folder, fetched by several processes or by hand; their table, and the command."""

from __future__ import annotations

import gzip
import hashlib
import io
import os
import re
import shutil
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from http_server import DATA, SHA256, Site, get, left, of

from bufgym.cli import trace_fetch
from bufgym.cli.options import Parser
from bufgym.errors import BufgymError
from bufgym.traces.datasets import download as downloading
from bufgym.traces.datasets import table
from bufgym.traces.datasets.fetch import cache_folder, fetch_dataset
from bufgym.traces.datasets.table import Remote, datasets

ROOT = Path(__file__).resolve().parents[2]

# -------------------- processes

FETCH = """
import sys
from pathlib import Path
from bufgym.traces.datasets.fetch import fetch_dataset
from bufgym.traces.datasets.table import Dataset, Remote
address, to, sha256 = sys.argv[1:]
dataset = Dataset("mine", "", "", "", "", None, "", (Remote("data.bin", address, sha256),))
print(fetch_dataset(dataset, Path(to))[0].origin)
"""


def fetching(site: Site, to: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", FETCH, f"{site.address}/data.bin", str(to), SHA256]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)


def test_killed_in_the_middle(site: Site, tmp_path: Path) -> None:
    site.drip = (10_000, 0.05)
    part = tmp_path / "mine" / ".data.bin.part"
    with fetching(site, tmp_path) as process:
        until = time.monotonic() + 30
        while downloading.size(part) < 50_000 and time.monotonic() < until:
            time.sleep(0.005)
        process.kill()
    kept = downloading.size(part)
    assert 50_000 <= kept < 300_000
    site.drip = None
    assert get(site, tmp_path).path.read_bytes() == DATA
    assert site.asked == [None, f"bytes={kept}-"]


def test_two_at_once_fetch_once(site: Site, tmp_path: Path) -> None:
    site.drip = (10_000, 0.02)
    with fetching(site, tmp_path) as one, fetching(site, tmp_path) as other:
        said = {one.communicate()[0].strip(), other.communicate()[0].strip()}
    assert said == {"downloaded", "there already"}
    assert site.asked == [None]
    assert (tmp_path / "mine" / "data.bin").read_bytes() == DATA


# -------------------- by hand


def test_from_a_file(tmp_path: Path) -> None:
    dataset = of(Remote("a.bin", "http://x/a.bin", SHA256), Remote("sub/b.bin", "http://x/b.bin"))
    (tmp_path / "download (1)").write_bytes(DATA)
    (tmp_path / "b.bin").write_bytes(b"1 2")
    renamed, known = fetch_dataset(dataset, tmp_path / "to", [tmp_path / "download (1)", tmp_path / "b.bin"])
    assert (renamed.path.name, renamed.known, renamed.origin) == ("a.bin", True, "copied")  # known by its sum
    assert (known.path, known.known) == (tmp_path / "to" / "mine" / "sub" / "b.bin", False)
    assert renamed.path.read_bytes() == DATA and known.path.read_bytes() == b"1 2"


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.bin", b"other", "a.bin: wrong checksum: sha256 is [0-9a-f]{64}, must be " + SHA256),
        (
            "c.bin",
            b"other",
            r"c.bin: no file of mine, by its name or its checksum \(sha256 [0-9a-f]{64}\).*: a.bin, b.bin",
        ),
        ("b.bin", b"<html>", "is an HTML page"),
        ("d.bin", None, r"no such file \(--from\)"),
    ],
)
def test_from_a_file_that_is_not_it(tmp_path: Path, name: str, content: bytes | None, says: str) -> None:
    dataset = of(Remote("a.bin", "http://x/a.bin", SHA256), Remote("b.bin", "http://x/b.bin"))
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(BufgymError, match=says):
        fetch_dataset(dataset, tmp_path / "to", [tmp_path / name])
    assert left(tmp_path / "to") == []


def test_without_an_address_only_by_hand(tmp_path: Path) -> None:
    with pytest.raises(BufgymError, match=r"ucc-4g: the address .* not known: fetch them by hand from https://www.ucc"):
        fetch_dataset("ucc-4g", tmp_path)
    with zipfile.ZipFile(tmp_path / "4G.zip", "w") as archive:
        archive.writestr("bus/a.csv", "x")
    done = fetch_dataset("ucc-4g", tmp_path / "to", [tmp_path / "4G.zip"])[0]
    assert done.unpacked == tmp_path / "to" / "ucc-4g" / "4G"
    assert (done.unpacked / "bus" / "a.csv").read_text() == "x"


# -------------------- archives


def test_an_archive_is_unpacked_beside_itself(site: Site, tmp_path: Path) -> None:
    for text in (b"old", b"new"):
        with zipfile.ZipFile(tmp_path / "made.zip", "w") as archive:
            archive.writestr("log.txt", text)
        site.data = (tmp_path / "made.zip").read_bytes()
        sum_now = hashlib.sha256(site.data).hexdigest()
        done = get(site, tmp_path, sum_now, path="logs.zip")
        assert done.unpacked is not None and (done.unpacked / "log.txt").read_bytes() == text
    assert left(tmp_path) == ["logs", "logs.zip"]
    shutil.rmtree(done.unpacked)
    assert (get(site, tmp_path, sum_now, path="logs.zip").unpacked or tmp_path).joinpath("log.txt").exists()
    assert len(site.asked) == 2


def test_an_archive_that_nothing_vouches_for_must_unpack(site: Site, tmp_path: Path) -> None:
    with pytest.raises(BufgymError, match=r"logs.zip: damaged, cut off, or no .zip archive"):
        get(site, tmp_path, None, path="logs.zip")
    assert left(tmp_path) == []


# -------------------- the table and the command


def test_the_table_says_what_is_known() -> None:
    summed = [path for dataset in datasets().values() for path in (f"{dataset.name}/{r.path}" for r in dataset.files)]
    assert len(summed) == len(set(summed))
    assert set(table.checksums()) <= set(summed)
    for dataset in datasets().values():
        assert dataset.page.startswith("https://") and dataset.citation and dataset.title
        for remote in dataset.files:
            assert remote.address.startswith("https://") and not {"..", ""} & set(remote.path.split("/"))
            assert remote.sha256 is None or re.fullmatch("[0-9a-f]{64}", remote.sha256)
            if "githubusercontent" in remote.address:
                assert re.search("/[0-9a-f]{40}/", remote.address)  # a commit, not a branch that moves
    assert datasets()["belgium-4g"].licence is None


def test_the_sums_are_those_of_the_recorded_files(shared_data: Path, tmp_path: Path) -> None:
    local_files = {
        "ucc-5g": ["ucc_5g/5G-production-dataset.zip"],
        "solis-wifi": ["solis_wifi/wifi_cafe_231115-151422.txt"],
        "evo-bags": ["rosbags/nav2_turtlebot.mcap", "rosbags/tf_example/metadata.yaml"],
    }
    for name, paths in local_files.items():
        done = fetch_dataset(name, tmp_path, [shared_data / path for path in paths])
        assert all(file.known for file in done)
    logs = sorted((tmp_path / "ucc-5g").rglob("Download/**/*.csv"))
    assert len(logs) > 0 and b"DL_bitrate" in logs[0].read_bytes()[:400]


def test_the_sums_of_uplinks_are_those_of_the_recorded_files(shared_data: Path) -> None:
    for name, folder in (("perama-wifi", "uplink_wifi"), ("mmwave-uplink", "uplink_mmwave")):
        known = {remote.path.replace("/", "_"): remote.sha256 for remote in datasets()[name].files}
        recorded = sorted((shared_data / folder).glob("*.gz"))
        assert len(known) == len(recorded) > 0
        for path in recorded:
            assert hashlib.sha256(gzip.decompress(path.read_bytes())).hexdigest() == known[path.stem]


def test_the_cache_is_where_the_platform_has_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "bufgym" / "datasets"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # to be ignored
    monkeypatch.setenv("HOME", str(tmp_path))
    if sys.platform == "linux":
        assert cache_folder() == tmp_path / ".cache" / "bufgym" / "datasets"


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., None]:
    """`fetch` with its words, as a command of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    parser = Parser()
    trace_fetch.add(parser.add_subparsers(required=True))

    def run(*words: str) -> None:
        options = parser.parse_args(["fetch", *words])
        options.command(options)

    return run


def test_the_command_lists(command: Callable[..., None], capsys: pytest.CaptureFixture[str]) -> None:
    command("--list")
    out = capsys.readouterr().out
    assert all(name in out for name in datasets()) and "not known" in out
    command("tum-rgbd", "--list")
    out = capsys.readouterr().out
    assert re.search("freiburg1_desk2-groundtruth.txt +sha256 not known", out) and "CC BY 4.0" in out


def test_the_command_fetches(
    command: Callable[..., None], site: Site, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    dataset = of(Remote("data.bin", f"{site.address}/data.bin"))
    monkeypatch.setitem(datasets(), "mine", dataset)
    command("mine")
    said = capsys.readouterr()
    assert f"{SHA256}  data.bin (none known)" in said.out
    assert re.search("licence +not known", said.out) and re.search("please cite +nobody", said.out)
    assert "data.bin: 300,000 bytes of 300,000" in said.err
    assert (cache_folder() / "mine" / "data.bin").read_bytes() == DATA


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], r"needs the NAME of a data set \(--list names them\)"),
        (["belgium"], "belgium: no such data set: must be one of belgium-4g"),
        (["ucc-4g"], "address of its files is not known"),
        (["ucc-5g", "--from", "nowhere.zip"], "nowhere.zip: no such file"),
    ],
)
def test_the_command_says_what_is_wrong(command: Callable[..., None], words: list[str], says: str) -> None:
    with pytest.raises(BufgymError, match=says) as caught:
        command(*words)
    assert "\n" not in str(caught.value)


def test_a_terminal_gets_a_bar(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("tqdm")
    from bufgym.cli.trace_fetch import _Bars

    screen = io.StringIO()
    screen.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stderr", screen)
    bars = _Bars()
    get(site, tmp_path, watch=bars.watch)
    bars.close()
    assert "data.bin" in screen.getvalue() and "300k" in screen.getvalue()


def test_files_are_as_readable_as_any_other(site: Site, tmp_path: Path) -> None:
    mask = os.umask(0o022)
    try:
        assert get(site, tmp_path).path.stat().st_mode & 0o777 == 0o644
    finally:
        os.umask(mask)
