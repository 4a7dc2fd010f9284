"""Archives from strangers: unpacked inside their folder, or refused."""

import gzip
import io
import random
import re
import stat
import struct
import tarfile
import zipfile
from pathlib import Path

import pytest
from refusal_cases import refuse

from bufgym.traces.datasets import unpack as unpacking
from bufgym.traces.datasets.unpack import unpack

DATA = random.Random(1).randbytes(300_000)
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
    contents = [("top/log.txt", b"1 2\n"), ("top/deep/er.bin", DATA)]
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
