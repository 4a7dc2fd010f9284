"""Archives from strangers: zips read as traces, and archives unpacked inside their folder or refused."""

import io
import random
import re
import stat
import struct
import tarfile
import zipfile
from pathlib import Path

import pytest
from link_files import SAMPLES, written

from bufgym.ground.errors import BufgymError, TraceError
from bufgym.traces import load, members, read_trace
from bufgym.traces.datasets import unpack as unpacking
from bufgym.traces.datasets.unpack import unpack
from bufgym.traces.formats import archives, text

DATA = random.Random(1).randbytes(300_000)
Members = dict[str, str | bytes]


def zipped(path: Path, contents: Members, method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in contents.items():
            archive.writestr(name, data)
    return path


def tarred(path: Path, *contents: tuple[str, bytes], kind: bytes = tarfile.REGTYPE, mode: str = "w:gz") -> Path:
    with tarfile.open(path, mode) as archive:  # type: ignore[call-overload]
        for name, content in contents:
            info = tarfile.TarInfo(name)
            info.size, info.type, info.linkname = len(content), kind, "elsewhere"
            archive.addfile(info, io.BytesIO(content))
    return path


def test_the_only_member_is_read(tmp_path: Path) -> None:
    others: Members = {"folder/": "", "folder/.DS_Store": "x", "__MACOSX/folder/._lte.csv": "x"}
    for format, method in (
        ("mahimahi", zipfile.ZIP_STORED),
        ("csv", zipfile.ZIP_DEFLATED),
        ("sabre", zipfile.ZIP_DEFLATED),
    ):
        plain = read_trace(written(tmp_path, SAMPLES[format], "lte.csv"))
        path = zipped(tmp_path / "data.zip", {"folder/lte.csv": SAMPLES[format], **others}, method)
        trace = read_trace(path)
        assert trace.name == "data" and f"format {format}, detected" in trace.source
        assert members(path) == ["folder/lte.csv"]
        assert read_trace(f"{path}:folder/lte.csv") == plain  # the member's name is the trace's


def test_one_of_several_members(tmp_path: Path) -> None:
    ucc = "Timestamp,DL_bitrate,UL_bitrate\n2020.01.01_00.00.00,8,16\n"
    contents: Members = {"a/car.csv": ucc, "a/bus.csv": "1\n1\n", "b/bus.csv": "1\n1\n1\n", "bus.csv": "2\n"}
    path = zipped(tmp_path / "data.zip", contents)
    assert members(path) == ["a/car.csv", "a/bus.csv", "b/bus.csv", "bus.csv"]
    assert read_trace(f"{path}:b/bus.csv").total_bytes == 4500
    assert read_trace(f"{path}:bus.csv").duration_us == 2000  # its whole name goes first
    # By its ending, which no other has.
    assert load(f"{path}:car.csv", column="UL_bitrate").total_bytes == 2 * load(f"{path}:car.csv").total_bytes > 0
    two = zipped(tmp_path / "two.zip", {"a/bus.csv": "1\n", "b/bus.csv": "1\n"})
    listed = r"4 members \(a/car.csv, a/bus.csv, b/bus.csv, ... 1 more\)"
    for name, says in {
        f"{path}": rf"data.zip: must name one as archive.zip:member: holds {listed}",
        f"{path}:ferry.csv": rf"member = ferry.csv: must be one of its {listed}",
        f"{two}:bus.csv": r"member = bus.csv: fits 2 members \(a/bus.csv, b/bus.csv\): must fit one",
        f"{tmp_path / 'no.zip'}:a.csv": r"no\.zip:a\.csv: no such file, and no shipped trace",
    }.items():
        with pytest.raises(TraceError, match=says):
            load(name)


def test_archives_without_a_file_or_damaged(tmp_path: Path) -> None:
    plain = written(tmp_path, "1\n", "plain.zip")
    assert read_trace(plain).total_bytes == 1500 and members(plain) == []  # told by its content, whatever its name
    assert read_trace(written(tmp_path, "1\n", "a.zip:b.csv")).total_bytes == 1500
    with pytest.raises(TraceError, match=r"holds 0 members \(none\)"):
        read_trace(zipped(tmp_path / "data.zip", {"folder/": ""}))
    with pytest.raises(TraceError, match=r"plain\.zip is no zip archive: cannot have members"):
        read_trace(f"{plain}:a.csv")
    with pytest.raises(TraceError, match="cannot be read"):
        members(tmp_path / "nothing.zip")
    whole = zipped(tmp_path / "data.zip", {"lte.csv": "\n".join(map(str, range(3000)))}).read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF
    for name, raw in (("cut.zip", whole[:-30]), ("flipped.zip, line .*", bytes(flipped))):
        with pytest.raises(TraceError, match=rf"{name}: zip data damaged or cut off"):
            read_trace(written(tmp_path, raw, name.split(",")[0]))


def test_limits_encryption_and_foreign_methods(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "data.zip"
    with pytest.raises(TraceError, match=r"member = lte\.csv: must be stored or deflated"):
        read_trace(zipped(path, {"lte.csv": "1\n"}, zipfile.ZIP_LZMA))
    raw = bytearray(zipped(path, {"lte.csv": "1\n"}).read_bytes())
    (directory,) = struct.unpack_from("<I", raw, raw.rindex(b"PK\x05\x06") + 16)
    raw[directory + 8] |= 1  # the flag "encrypted" of the list's first entry
    with pytest.raises(TraceError, match=r"member = lte\.csv: is encrypted: must not be"):
        read_trace(written(tmp_path, bytes(raw), "secret.zip"))
    monkeypatch.setattr(text, "MAX_TEXT_BYTES", 10**6)
    assert zipped(path, {"lte.csv": "7\n" * 5_000_000}).stat().st_size < 20_000
    with pytest.raises(TraceError, match="more than 1000000 bytes of text"):
        read_trace(path)
    monkeypatch.setattr(archives, "MAX_DIRECTORY_BYTES", 2000)
    with pytest.raises(TraceError, match=r"list of members of \d+ bytes: must be at most 2000"):
        read_trace(zipped(path, {f"{k}.csv": "1\n" for k in range(50)}))


def test_archives_unpack(tmp_path: Path) -> None:
    contents = [("top/log.txt", b"1 2\n"), ("top/deep/er.bin", DATA)]
    modes = {"a.tgz": "w:gz", "a.tar.gz": "w:gz", "a.tar.bz2": "w:bz2", "a.tar.xz": "w:xz", "a.tar": "w"}
    packed = [tarred(tmp_path / name, *contents, mode=mode) for name, mode in modes.items()]
    for archive in (zipped(tmp_path / "a.zip", {**dict(contents), "__MACOSX/top/._log.txt": b"junk"}), *packed):
        out = tmp_path / f"{archive.name}.out"
        unpack(archive, out)
        assert {str(path.relative_to(out)): path.read_bytes() for path in out.rglob("*.*")} == dict(contents)


@pytest.mark.parametrize("name", ["../out.txt", "/tmp/out.txt", "a/../../out.txt", "C:out.txt", "a\\..\\out.txt"])
@pytest.mark.parametrize("kind", ["zip", "tgz"])
def test_no_way_out_of_the_folder(tmp_path: Path, kind: str, name: str) -> None:
    path, contents = tmp_path / f"a.{kind}", {"fine.txt": b"x", name: b"x"}
    archive = zipped(path, {**contents}) if kind == "zip" else tarred(path, *contents.items())
    with pytest.raises(BufgymError, match=f"member = .*{re.escape(name[-7:])}.*: leads out of its folder"):
        unpack(archive, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == [archive.name]


def test_what_is_no_file_comes_twice_or_is_too_much_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(archive: Path, says: str) -> None:
        with pytest.raises(BufgymError, match=says):
            unpack(archive, tmp_path / "out", 10**6)
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
    (tmp_path / "a.tar").write_bytes(info.tobuf(tarfile.USTAR_FORMAT) + bytes(10_240))
    refused(tmp_path / "a.tar", "a header of 2147483648 bytes: must be at most")
    monkeypatch.setattr(unpacking, "MAX_MEMBERS", 3)
    refused(zipped(path, {f"{k}": b"" for k in range(4)}), "or 3 files: must be less")
    refused(tarred(tgz, *((f"{k}", b"") for k in range(4))), "or 3 files: must be less")
