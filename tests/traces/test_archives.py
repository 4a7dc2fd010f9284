"""Zip archives of traces: the only member, one of several by name, and archives that are not to be trusted."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path

import pytest
from link_files import SAMPLES, written

from bufgym.errors import TraceError
from bufgym.traces import members, read_trace
from bufgym.traces.formats import archives, text


def zipped(folder: Path, contents: dict[str, str | bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    path = folder / "data.zip"
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, text in contents.items():
            archive.writestr(name, text)
    return path


@pytest.mark.parametrize("format", SAMPLES)
@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_the_only_member_is_read(tmp_path: Path, format: str, method: int) -> None:
    plain = read_trace(written(tmp_path, SAMPLES[format], "lte.csv"))
    path = zipped(
        tmp_path,
        {"folder/": "", "folder/lte.csv": SAMPLES[format], "folder/.DS_Store": "x", "__MACOSX/folder/._lte.csv": "x"},
        method,
    )
    trace = read_trace(path)
    assert trace.name == "data" and f"format {format}, detected" in trace.source
    assert trace.time_us.tolist() == plain.time_us.tolist()
    assert trace.cumulative_bytes.tolist() == plain.cumulative_bytes.tolist()
    assert members(path) == ["folder/lte.csv"]
    assert read_trace(f"{path}:folder/lte.csv") == plain  # the member's name is the trace's


def test_one_of_several_members(tmp_path: Path) -> None:
    path = zipped(tmp_path, {"a/car.csv": "1\n", "a/bus.csv": "1\n1\n", "b/bus.csv": "1\n1\n1\n", "bus.csv": "2\n"})
    assert members(path) == ["a/car.csv", "a/bus.csv", "b/bus.csv", "bus.csv"]
    assert read_trace(f"{path}:b/bus.csv").total_bytes == 4500
    assert read_trace(f"{path}:car.csv").total_bytes == 1500  # by its ending, which no other has
    assert read_trace(f"{path}:bus.csv").duration_us == 2000  # its whole name goes first
    listed = r"4 members \(a/car.csv, a/bus.csv, b/bus.csv, ... 1 more\)"
    with pytest.raises(TraceError, match=rf"data.zip: must name one as archive.zip:member: holds {listed}"):
        read_trace(path)
    with pytest.raises(TraceError, match=rf"member = ferry.csv: must be one of its {listed}"):
        read_trace(f"{path}:ferry.csv")
    two = zipped(tmp_path, {"a/bus.csv": "1\n", "b/bus.csv": "1\n"})
    with pytest.raises(TraceError, match=r"member = bus.csv: fits 2 members \(a/bus.csv, b/bus.csv\): must fit one"):
        read_trace(f"{two}:bus.csv")


def test_archives_without_a_file(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match=r"holds 0 members \(none\)"):
        read_trace(zipped(tmp_path, {"folder/": ""}))
    with pytest.raises(TraceError, match="no such file"):
        read_trace(tmp_path / "nothing.zip:a.csv")
    plain = written(tmp_path, "1\n", "plain.zip")
    assert read_trace(plain).total_bytes == 1500  # told by its content, whatever its name
    assert members(plain) == []
    with pytest.raises(TraceError, match=r"plain\.zip is no zip archive: cannot have members"):
        read_trace(f"{plain}:a.csv")
    with pytest.raises(TraceError, match="cannot be read"):
        members(tmp_path / "nothing.zip")


def test_a_file_whose_name_looks_like_a_member(tmp_path: Path) -> None:
    assert read_trace(written(tmp_path, "1\n", "a.zip:b.csv")).total_bytes == 1500


def test_damaged_archives(tmp_path: Path) -> None:
    whole = zipped(tmp_path, {"lte.csv": "\n".join(map(str, range(3000)))}).read_bytes()
    broken = written(tmp_path, whole[:-30], "cut.zip")
    with pytest.raises(TraceError, match=r"cut\.zip: zip data damaged or cut off"):
        read_trace(broken)
    with pytest.raises(TraceError, match=r"cut\.zip: zip data damaged or cut off"):
        members(broken)
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF
    with pytest.raises(TraceError, match=r"flipped.zip, line \d+: zip data damaged or cut off"):
        read_trace(written(tmp_path, bytes(flipped), "flipped.zip"))


def test_a_bomb_in_a_zip_stops_at_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text, "MAX_TEXT_BYTES", 10**6)
    path = zipped(tmp_path, {"lte.csv": "7\n" * 5_000_000})
    assert path.stat().st_size < 20_000
    with pytest.raises(TraceError, match="more than 1000000 bytes of text"):
        read_trace(path)


def test_a_list_of_members_beyond_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = zipped(tmp_path, {f"{k}.csv": "1\n" for k in range(50)})
    monkeypatch.setattr(archives, "MAX_DIRECTORY_BYTES", 2000)
    with pytest.raises(TraceError, match=r"list of members of \d+ bytes: must be at most 2000"):
        read_trace(path)


def test_encrypted_and_foreign_methods(tmp_path: Path) -> None:
    with pytest.raises(TraceError, match=r"member = lte\.csv: must be stored or deflated"):
        read_trace(zipped(tmp_path, {"lte.csv": "1\n"}, zipfile.ZIP_LZMA))
    raw = bytearray(zipped(tmp_path, {"lte.csv": "1\n"}).read_bytes())
    (directory,) = struct.unpack_from("<I", raw, raw.rindex(b"PK\x05\x06") + 16)
    raw[directory + 8] |= 1  # the flag "encrypted" of the list's first entry
    assert zipfile.ZipFile(io.BytesIO(bytes(raw))).infolist()[0].flag_bits & 1
    with pytest.raises(TraceError, match=r"member = lte\.csv: is encrypted: must not be"):
        read_trace(written(tmp_path, bytes(raw), "secret.zip"))
