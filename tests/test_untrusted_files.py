"""Untrusted files: what is too large, endless, forged or no regular file ends in one line, and soon."""

import csv
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from cli_cases import Capsys, fails, shown
from refusal_cases import refuse

from bufgym.benchmark import leaderboard
from bufgym.cli import main
from bufgym.scenario import read_client
from bufgym.utils.errors import BufgymError, printable

REPO = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        ("a" + ".a" * 40_000 + " = 1", "line 1: must have at most 100 dots"),
        ("a = " + "[" * 100_000, "nested too deep"),
        ("window = " + "9" * 5000, "Exceeds the limit"),
        ("x" * 2**19, "larger than 262144 bytes"),
        (b"\xff\xfe", "must be UTF-8 text"),
    ],
)
def test_toml_without_bounds_is_refused(tmp_path: Path, text: str | bytes, rule: str) -> None:
    path = tmp_path / "client.toml"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    with pytest.raises(BufgymError, match=rule) as error:
        read_client(path)
    assert str(error.value).count(str(path)) == 1


@pytest.mark.parametrize("command", ["bench --scenario", "trace info", "trace from-bag", "report", "bench --workload"])
def test_devices_and_fifos_are_refused(tmp_path: Path, command: str, capsys: Capsys) -> None:
    os.mkfifo(tmp_path / "fifo")
    for path in ("/dev/zero", str(tmp_path / "fifo")):
        fails([*command.split(), path], path, capsys)


def test_a_row_is_not_believed_its_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    """A forged value needs a wide interval; what counts is the interval that is computed now."""
    entry = leaderboard.Entry("lte-v1", "afr", 1, 3, {"score": leaderboard.Interval(0.5, 0.4, 0.6)}, "0.1.0")
    monkeypatch.setattr(leaderboard, "_run", lambda *a, **k: [entry])
    assert leaderboard.validate(entry) is entry
    for value, low, high in ((0.9, -9, 9), (0.5, -9, 9), (0.9, 0.85, 0.95), (0.61, 0.4, 0.6), (float("nan"), 0.4, 0.6)):
        forged = leaderboard.replace(entry, values={"score": leaderboard.Interval(value, low, high)})
        refuse(r"score is 0.500000 \[0.400000, 0.600000\], but the file states", leaderboard.validate, forged)


CELLS = ["lte-v1", "afr", "1", "3", "score", "0.5", "0.4", "0.6", "0.1", "unknown", "x"]
ROW = dict(zip(leaderboard.COLUMNS, CELLS, strict=True))


@pytest.mark.parametrize(
    ("data", "rule"),
    [
        ({"rank": "first"}, "line 2: rank = 'first': must be a number"),
        ({"quantity": "luck"}, "line 2: quantity = luck: must be one of"),
        ({"value": "0.5,0.6"}, "line 2: value = '0.5,0.6': must be a number"),
        ({"command": "x" * 200_000}, "no rows that can be read: field larger"),
        *((data, "board.csv") for data in (b"\xff\xfe\x00", b"a,b\n1,2\n", b"", b"\x00" * 50)),
    ],
)
def test_a_leaderboard_that_was_tampered_with(tmp_path: Path, data: Any, rule: str, capsys: Capsys) -> None:
    path = tmp_path / "board.csv"
    fails(["validate", "lte-v1/afr", "--file", path], "board.csv", capsys)
    if isinstance(data, bytes):
        path.write_bytes(data)
    else:
        with path.open("w", newline="") as file:
            csv.writer(file).writerows([leaderboard.COLUMNS, (ROW | data).values()])
    fails(["validate", "lte-v1/afr", "--file", path], rule, capsys)


def test_what_is_printable_stays_and_all_else_is_written_out() -> None:
    assert printable("lte 4 \N{MULTIPLICATION SIGN} caf\N{LATIN SMALL LETTER E WITH ACUTE}") == "lte 4 × café"
    assert printable("a\nb\x1b[31m\x07\x9b\u202e\ud800\x00") == r"a\nb\x1b[31m\x07\x9b\u202e\ud800\x00"
    assert printable(printable("\x1b")) == r"\x1b"
    assert str(BufgymError("a\nb")) == r"a\nb"


FORGED = "x\nOK     all.csv: 9 s, mean 9 KB\x1b[2K\x1b[31m/s"


def test_a_file_s_name_forges_no_line(tmp_path: Path, capsys: Capsys) -> None:
    paths = [tmp_path / FORGED, tmp_path / f"{FORGED}y"]
    paths[0].parent.mkdir()
    for path, text in zip(paths, ("1\n2\n", "broken"), strict=True):
        path.write_text(text)
    assert main(["trace", "validate", *map(str, paths)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert all(line.isprintable() for line in lines)
    assert [line.split()[0] for line in lines] == ["OK", "error", "1"]
    assert all(line.isprintable() for line in shown(["trace", "info", str(paths[0])], capsys).splitlines())


def ran(words: str, **options: Any) -> subprocess.CompletedProcess[bytes]:
    options = options or {"capture_output": True}
    where = {**os.environ, "PYTHONPATH": str(REPO), "PYTHONIOENCODING": "utf-8"}
    return subprocess.run([sys.executable, "-m", "bufgym", *words.split()], cwd=REPO, env=where, **options)


@pytest.mark.nightly
def test_output_that_is_closed_or_full() -> None:
    shell = f"{sys.executable} -m bufgym"
    for command, code in ((f"{shell} list rewards >&-", 0), (f"{shell} trace info nowhere >&- 2>&-", 2)):
        done = subprocess.run(["sh", "-c", command], cwd=REPO, capture_output=True)
        assert (done.returncode, done.stdout, done.stderr) == (code, b"", b"")
    if Path("/dev/full").exists():
        with open("/dev/full", "wb") as full:
            done = ran("list rewards", stdout=full, stderr=subprocess.PIPE)
        assert done.returncode == 2 and done.stderr.count(b"\n") == 1 and b"Traceback" not in done.stderr
