"""Recordings and archives that unpack to more than they may, or hold more than any robot sends: refused, and soon."""

from __future__ import annotations

import lzma
import os
import sqlite3
import tarfile
from pathlib import Path

import bag_cases as cases
import pytest
import zstandard
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from bufgym.errors import BufgymError, TraceError
from bufgym.files import FREELY_UNPACKED_BYTES
from bufgym.traces.datasets.unpack import unpack
from bufgym.traces.formats import bag_files
from bufgym.traces.formats.bags import read_bag


@pytest.fixture
def few_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """100 kB may be unpacked from next to nothing, instead of 64 MiB."""
    monkeypatch.setattr("bufgym.files.FREELY_UNPACKED_BYTES", 100_000)


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_a_packed_rosbag2_unpacks_to_no_more_than_it_may(
    tmp_path: Path, few_bytes: None, mode: CompressionMode
) -> None:
    entries = [(0, "/t", "std_msgs/msg/String", cases.text("x" * 20_000_000))]
    path = cases.write_rosbag2(tmp_path / "bomb", entries, StoragePlugin.SQLITE3, mode)
    assert sum(file.stat().st_size for file in path.iterdir()) < 50_000
    with pytest.raises(TraceError, match=r"bomb: .*unpacks to more than \d+ bytes: must be less"):
        read_bag(path)


def test_a_message_unpacks_to_no_more_than_a_chunk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bag_files, "MAX_CHUNK_BYTES", 1000)
    path = cases.write_rosbag2(tmp_path / "bomb", cases.drive(), StoragePlugin.SQLITE3, CompressionMode.MESSAGE)
    assert len(read_bag(path).time_ns) == 9
    with sqlite3.connect(path / "bomb.db3") as base:
        base.execute("UPDATE messages SET data = ?", (zstandard.compress(bytes(2000)),))
    with pytest.raises(TraceError, match="a message of more than 1000 bytes"):
        read_bag(path)


def test_many_chunks_of_a_recording_unpack_to_no_more_than_all_may(tmp_path: Path, few_bytes: None) -> None:
    bomb = cases.write_mcap(tmp_path / "b.mcap", [(ms, "/t", "x", bytes(50_000)) for ms in range(60)])
    with pytest.raises(TraceError, match="unpacks to more than"):
        read_bag(bomb)


def test_the_metadata_of_a_rosbag2_is_bounded(tmp_path: Path) -> None:
    path = cases.write_rosbag2(tmp_path / "drive", cases.drive(), StoragePlugin.SQLITE3)
    file = path / "metadata.yaml"
    text = file.read_text()
    file.write_text(text + "  deep: " + "[" * 100_000)  # of no interest, and seconds in a parser of YAML
    assert len(read_bag(path).time_ns) == 9
    for storage in ("pickle", "[sqlite3]"):
        file.write_text(text.replace("storage_identifier: sqlite3", f"storage_identifier: {storage}"))
        with pytest.raises(TraceError, match="must be sqlite3 or mcap"):
            read_bag(path)
    with open(file, "wb") as sparse:
        sparse.truncate(1 << 32)
    with pytest.raises(BufgymError, match="larger than 8388608 bytes"):
        read_bag(path)


def test_a_recording_s_files_lie_in_its_folder_and_are_regular(tmp_path: Path) -> None:
    path = cases.write_rosbag2(tmp_path / "drive", cases.drive(), StoragePlugin.SQLITE3)
    file = path / "metadata.yaml"
    file.write_text(file.read_text().replace("- drive.db3", "- ../../../dev/zero"))
    with pytest.raises(TraceError, match="zero: must be a regular file"):
        read_bag(path)
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "folder" / "a.mcap")
    with pytest.raises(TraceError, match=r"a\.mcap: must be a regular file"):
        read_bag(tmp_path / "folder")


def test_sqlite_computes_nothing_of_its_own(tmp_path: Path) -> None:
    """A column of a gigabyte that is computed when it is read."""
    path = tmp_path / "bomb.db3"
    with sqlite3.connect(path) as base:
        base.execute("CREATE TABLE topics(id, name, type, serialization_format)")
        base.execute("INSERT INTO topics VALUES (1, '/t', 'x', 'cdr')")
        base.execute("CREATE TABLE messages(topic_id, timestamp, data AS (zeroblob(900000000)))")
        base.execute("INSERT INTO messages VALUES (1, 0)")
    with pytest.raises(TraceError, match="cut off or damaged"):
        read_bag(path)


def test_a_recording_of_very_many_topics_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from bufgym.traces.formats import bags

    path = cases.write_mcap(tmp_path / "m.mcap", [(k, f"/t{k}", "x", b"1") for k in range(2000)])
    assert len(read_bag(path).topics) == 2000
    monkeypatch.setattr(bags, "MAX_TOPICS", 1999)
    with pytest.raises(TraceError, match="more than 1999 topics"):
        read_bag(path)


def test_zeros_in_an_archive_of_little_are_refused(tmp_path: Path) -> None:
    """200 MB in 30 kB: refused from the header's own number, before a byte is written."""
    path = tmp_path / "zeros.tar.xz"
    size = FREELY_UNPACKED_BYTES + 100_000_000
    header = tarfile.TarInfo("zeros.csv")
    header.size = size
    with lzma.open(path, "wb", preset=0) as file:
        file.write(header.tobuf())
        for _ in range(size // 10**6):
            file.write(bytes(10**6))
    with pytest.raises(BufgymError, match=r"unpacks to more than \d+ bytes"):
        unpack(path, tmp_path / "zeros")
    assert not (tmp_path / "zeros").exists()
