"""`bufgym trace info|plot|validate|convert` as a user calls them."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

import pytest
from link_files import SAMPLES, written

from bufgym.cli import main
from bufgym.traces import read_trace


def failed(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What the command said on stderr, in its one line, when it ended with 2."""
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith("bufgym: error: ") and said.count("\n") == 1
    return said


def an_archive(folder: Path) -> Path:
    path = folder / "two.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a/ucc.csv", SAMPLES["ucc"])
        archive.writestr("a/nyu.csv", SAMPLES["nyu"])
    return path


def test_info_of_every_format(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["trace", "info", *(str(written(tmp_path, text, format)) for format, text in SAMPLES.items())]) == 0
    for format, block in zip(SAMPLES, capsys.readouterr().out.split("\n\n"), strict=True):
        assert block.startswith(f"{format}\n") and f"(format {format}, detected" in block
        for key in ("duration_s", "mean_KBps", "min_KBps", "max_KBps", "seconds_below_500KBps", "longest_run_below"):
            assert f"\n  {key}" in block


def test_info_by_format_and_column_out_of_a_zip(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    member = f"{an_archive(tmp_path)}:ucc.csv"
    assert main(["trace", "info", member, "--format", "ucc", "--column", "UL_bitrate"]) == 0
    out = capsys.readouterr().out
    assert "(format ucc, requested, column UL_bitrate," in out
    # 20 and 8 kbit/s are 2.5 and 1 KB/s.
    assert ["mean_KBps", "1.75"] in [line.split() for line in out.splitlines()]
    assert "--format" not in failed(["trace", "info", member, "--column", "Speed"], capsys)


def test_validate_tells_sound_files_from_broken_ones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sound, broken = written(tmp_path, "1\n2\n", "sound.up"), written(tmp_path, "1\nx\n", "broken.up")
    assert main(["trace", "validate", str(sound), "lte-synthetic-0"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == ["OK", "OK", "2"]
    with pytest.raises(SystemExit) as ended:
        main(["trace", "validate", str(sound), str(broken), str(tmp_path / "missing"), str(an_archive(tmp_path))])
    assert ended.value.code == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:-1]] == ["OK", "error", "error", "OK", "OK"]  # a zip's members, too
    assert lines[-1] == "3 of 5 files are sound"
    assert "sound.up (format mahimahi, detected): 0.0 s, mean 1500.0 KB/s" in lines[0]
    assert "broken.up, line 2: time in ms = x: must be a whole number" in lines[1]
    assert "a/nyu.csv (format nyu, detected): 3.0 s" in lines[4]


def test_convert_states_what_was_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = written(tmp_path, SAMPLES["rates"], "link.csv")  # 2005 bytes in 3.75 s
    up, back = tmp_path / "link.up", tmp_path / "back.csv"
    assert main(["trace", "convert", str(source), "--to", "mahimahi", "--out", str(up)]) == 0
    assert up.read_text() == "1500\n3750\n"
    out = capsys.readouterr().out
    assert out.startswith(f"wrote {up} (format mahimahi) from {source} (format rates, detected): total +995 bytes, ")
    assert main(["trace", "convert", str(up), "--out", str(back)]) == 0  # .csv says the format
    assert capsys.readouterr().out.endswith(": nothing lost\n")
    assert read_trace(back).time_us.tolist() == read_trace(up).time_us.tolist()


def test_convert_many_into_a_folder_and_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = str(written(tmp_path, "1\n", "a.up")), str(written(tmp_path, "2\n", "b.up"))
    convert, out = ["trace", "convert", first, "--out"], str(tmp_path / "out")
    both = ["trace", "convert", first, second, "--to", "csv", "--out", out]
    assert "must be an existing folder" in failed(both, capsys)
    (tmp_path / "out").mkdir()
    assert main(both) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["a.up.csv", "b.up.csv"]
    for words, says in (
        ([out, "--to", "csv"], "a.up.csv is taken"),
        ([str(tmp_path / "x.up")], "must be one of csv, mahimahi"),
        (["x", "--to", "json"], "--to json: must be one of csv, mahimahi"),
        ([first, "--to", "csv"], "must not be the file that is read"),
    ):
        assert says in failed([*convert, *words], capsys)
    assert Path(first).read_text() == "1\n"


def test_plot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    paths = [str(written(tmp_path, SAMPLES[format], format)) for format in ("nyu", "mahimahi")]
    for ending, magic in ((".png", b"\x89PNG"), (".svg", b"<?xm")):
        out = tmp_path / f"picture{ending}"
        assert main(["trace", "plot", *paths, "--out", str(out)]) == 0
        assert out.read_bytes()[:4] == magic
    for name in ("matplotlib", "matplotlib.figure"):  # loaded for pictures only
        monkeypatch.setitem(sys.modules, name, None)
    assert main(["trace", "validate", paths[0]]) == 0
