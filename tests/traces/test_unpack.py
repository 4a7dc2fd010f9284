"""Archives from strangers: unpacked inside their folder, up to a stated size, or refused."""

from __future__ import annotations

import io
import random
import re
import shutil
import stat
import struct
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from bufgym.errors import BufgymError
from bufgym.traces.datasets import unpack as unpacking
from bufgym.traces.datasets.unpack import unpack

DATA = random.Random(1).randbytes(300_000)


def zipped(path: Path, *members: tuple[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return path


def tarred(path: Path, *members: tuple[str, bytes], kind: bytes = tarfile.REGTYPE, mode: str = "w:gz") -> Path:
    with tarfile.open(path, mode) as archive:  # type: ignore[call-overload]
        for name, content in members:
            info = tarfile.TarInfo(name)
            info.size, info.type, info.linkname = len(content), kind, "elsewhere"
            archive.addfile(info, io.BytesIO(content))
    return path


@pytest.mark.parametrize("name", ["a.zip", "a.tgz", "a.tar.gz", "a.tar.bz2", "a.tar.xz", "a.tar"])
def test_archives_unpack(tmp_path: Path, name: str) -> None:
    members = [("top/log.txt", b"1 2\n"), ("top/deep/er.bin", DATA)]
    if name == "a.zip":
        archive = zipped(tmp_path / name, *members, ("__MACOSX/top/._log.txt", b"junk"))
    else:
        mode = {"tgz": "w:gz", "tar": "w"}.get(name.split(".", 1)[1], f"w:{name.split('.')[-1]}")
        archive = tarred(tmp_path / name, *members, mode=mode)
    paths = unpack(archive, tmp_path / "out")
    assert [str(path.relative_to(tmp_path / "out")) for path in paths] == ["top/log.txt", "top/deep/er.bin"]
    assert paths[0].read_bytes() == b"1 2\n" and paths[1].read_bytes() == DATA


@pytest.mark.parametrize("name", ["../out.txt", "/tmp/out.txt", "a/../../out.txt", "C:out.txt", "a\\..\\out.txt"])
@pytest.mark.parametrize("make", [zipped, tarred])
def test_no_way_out_of_the_folder(tmp_path: Path, make: Callable[..., Path], name: str) -> None:
    archive = make(tmp_path / f"a.{'zip' if make is zipped else 'tgz'}", ("fine.txt", b"x"), (name, b"x"))
    with pytest.raises(BufgymError, match=f"member = .*{re.escape(name[-7:])}.*: leads out of its folder"):
        unpack(archive, tmp_path / "out")
    assert [path.name for path in tmp_path.iterdir()] == [archive.name]


def test_links_devices_and_twins_are_refused(tmp_path: Path) -> None:
    for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.FIFOTYPE):
        with pytest.raises(BufgymError, match="member = link: must be a plain file"):
            unpack(tarred(tmp_path / "a.tgz", ("link", b""), kind=kind), tmp_path / "out")
    link = zipfile.ZipInfo("link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr(link, "/etc/passwd")
    with pytest.raises(BufgymError, match="member = link: must be a plain file"):
        unpack(tmp_path / "a.zip", tmp_path / "out")
    with pytest.raises(BufgymError, match="member = twin: must come only once"):
        unpack(tarred(tmp_path / "a.tgz", ("twin", b"1"), ("twin", b"2")), tmp_path / "out")
    nameless = zipped(tmp_path / "a.zip", ("nul", b"1"))
    nameless.write_bytes(nameless.read_bytes().replace(b"nul", b"\0ul"))
    with pytest.raises(BufgymError, match=r"damaged, cut off, or no \.zip archive"):
        unpack(tmp_path / "a.zip", tmp_path / "out")
    with pytest.raises(BufgymError, match="holds no file"):
        unpack(zipped(tmp_path / "a.zip"), tmp_path / "out")


def test_bombs_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    honest = zipped(tmp_path / "a.zip", ("zeros", bytes(1_000_001)))
    with pytest.raises(BufgymError, match="unpacks to more than 1000000 bytes"):
        unpack(honest, tmp_path / "out", 1_000_000)
    # The size that the zip's directory states, made smaller: the copying counts for itself.
    raw = bytearray(honest.read_bytes())
    lying = tmp_path / "b.zip"
    lying.write_bytes(raw.replace(struct.pack("<I", 1_000_001), struct.pack("<I", 10)))
    with pytest.raises(BufgymError, match=r"unpacks to more|damaged"):
        unpack(lying, tmp_path / "out", 1_000_000)
    with pytest.raises(BufgymError, match=r"unpacks to more than 1000000 bytes \(at second\)"):
        unpack(
            tarred(tmp_path / "a.tgz", ("first", bytes(600_000)), ("second", bytes(600_000))), tmp_path / "out", 10**6
        )
    monkeypatch.setattr(unpacking, "MAX_MEMBERS", 3)
    many = [(f"{k}", b"") for k in range(4)]
    with pytest.raises(BufgymError, match="3 files: must be less"):
        unpack(zipped(tmp_path / "a.zip", *many), tmp_path / "out")
    with pytest.raises(BufgymError, match="more than 3 members"):
        unpack(tarred(tmp_path / "a.tgz", *many), tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.tgz", "a.zip", "b.zip"]


def test_a_header_of_absurd_length_is_refused(tmp_path: Path) -> None:
    """tarfile would read an extended header of any announced length into memory."""
    info = tarfile.TarInfo("x")
    info.type, info.size = tarfile.XHDTYPE, 2**31
    (tmp_path / "a.tar").write_bytes(info.tobuf(tarfile.USTAR_FORMAT) + bytes(10_240))
    with pytest.raises(BufgymError, match="a header of 2147483648 bytes: must be at most"):
        unpack(tmp_path / "a.tar", tmp_path / "out")


@pytest.mark.parametrize("name", ["a.zip", "a.tgz"])
def test_mutilated_archives_end_in_a_result_or_our_error(tmp_path: Path, name: str) -> None:
    make = zipped if name == "a.zip" else tarred
    whole = make(tmp_path / name, ("one.txt", b"1 2\n" * 50), ("two/three.txt", DATA[:500])).read_bytes()
    dice, refused = random.Random(7), 0
    for _ in range(80):
        raw = bytearray(whole)
        for _ in range(dice.randint(1, 4)):
            raw[dice.randrange(len(raw))] = dice.randrange(256)
        (tmp_path / name).write_bytes(raw[: dice.choice([len(raw), dice.randrange(len(raw))])])
        try:
            unpack(tmp_path / name, tmp_path / "out")
        except BufgymError:
            refused += 1
            assert not (tmp_path / "out").exists()
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
    assert refused > 40
    assert [path.name for path in tmp_path.iterdir()] == [name]
