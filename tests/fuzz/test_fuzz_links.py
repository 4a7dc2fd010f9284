"""Whatever is in a link file, reading it ends in a sound trace or in an error of bufgym's own that names the file.

A failure shows the seed and the number of its input in the file's name.

Inputs are files of each format, recorded ones where they are present, mutated: bytes flipped, parts cut out, doubled or
swapped with another file's, numbers and lines of absurd size put in; some packed as gzip or zip before or after that.
"""

from __future__ import annotations

import gzip
import io
import json
import os
import random
import signal
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from link_files import HEADER, SAMPLES, written
from mutations import COUNT, SEED, mutated

from bufgym.errors import BufgymError, TraceError
from bufgym.traces import FORMATS, members, read_trace

BATCHES = 8
HANG_S = 60
MOST_BYTES = 2 * 10**9


@contextmanager
def no_hang() -> Iterator[None]:
    """A reader that never ends fails its test, where the system has alarms."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"a reader took more than {HANG_S} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(HANG_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def ends_well(path: Path, format: str | None, column: str | None = None) -> bool:
    """Read it: whether there was a trace; anything but that or bufgym's own error fails the test."""
    with no_hang():
        try:
            trace = read_trace(path, format, column=column)
        except TraceError as error:
            assert path.name in str(error) and len(str(error)) < 1500
            return False
        except BufgymError as error:
            assert "column" in str(error)
            return False
    assert trace.total_bytes > 0 and 0 < trace.duration_us <= 10**13
    return True


def packed(uniform: random.Random, data: bytes) -> bytes:
    if uniform.random() < 0.5:
        return gzip.compress(data, 1)
    target = io.BytesIO()
    with zipfile.ZipFile(target, "w", uniform.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])) as archive:
        for k in range(uniform.choice([1, 1, 1, 2])):
            archive.writestr(f"{k}.csv", data)
    return target.getvalue()


def seeds() -> list[tuple[str, bytes]]:
    """A file of each format, and the beginnings of recorded ones."""
    files = [(format, text.encode()) for format, text in SAMPLES.items()]
    named = os.environ.get("BUFGYM_SHARED_DATA")
    data = Path(named) if named else Path(__file__).resolve().parents[3] / "shared" / "data"
    for format, pattern in {
        "mahimahi": "mahimahi/*.gz",
        "csv": "belgium_4g/csv/*foot*.csv",
        "belgium": "belgium_4g/raw/*.log",
        "sabre": "belgium_4g/sabre_json/*foot*.json",
        "mbit": "norway_hsdpa/cooked/*bus*",
        "nuttcp": "uplink_5g/*.gz",
        "iperf3": "uplink_wifi/*.gz",
        "runs": "uplink_mmwave/*.gz",
    }.items():
        for path in sorted(data.glob(pattern))[:3]:
            raw = path.read_bytes()
            files.append((format, (gzip.decompress(raw) if path.suffix == ".gz" else raw)[:3000]))
    for path in data.glob("ucc_5g/*.zip"):
        with zipfile.ZipFile(path) as archive, archive.open(members(path)[0]) as member:
            files.append(("ucc", member.read(3000)))
    return files


@pytest.mark.parametrize("batch", range(BATCHES))
def test_mutated_files_end_well(tmp_path: Path, batch: int) -> None:
    resource = pytest.importorskip("resource")
    files = seeds()
    others = [data for _, data in files]
    read = 0
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for k in range(batch, COUNT, BATCHES):
        uniform = random.Random(f"{SEED}-{k}")
        format, data = uniform.choice(files)
        data = mutated(uniform, data, others)
        if uniform.random() < 0.2:
            data = packed(uniform, data)
            data = mutated(uniform, data, others) if uniform.random() < 0.5 else data
        column = uniform.choice([None, None, None, "UL_bitrate"])
        path = written(tmp_path, data, f"fuzz-{SEED}-{k}")
        read += ends_well(path, uniform.choice([None, None, format, uniform.choice(list(FORMATS))]), column)
        path.unlink()
    assert COUNT < 400 or read > 0  # mutations are mild enough for some to be sound
    # Kilobytes on Linux; the greatest that the process ever had.
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < MOST_BYTES


CELLS = st.one_of(
    st.integers(-5, 10**14).map(str),
    st.floats(allow_nan=True).map(str),
    st.sampled_from(["", "-0", "1e999", "٣", "+", "Mbits/sec", "2019.12.16_13.40.04", "{}", "["]),
)
HEADERS = ["", HEADER, "time_s,bytes_per_s\n", "Timestamp,DL_bitrate,UL_bitrate\n", "[", "\n\n"]


@settings(max_examples=max(150, COUNT // 20), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    lines=st.lists(st.lists(CELLS, min_size=1, max_size=7), max_size=6),
    separator=st.sampled_from([" ", ",", "\t"]),
    format=st.sampled_from([None, *FORMATS]),
    header=st.sampled_from(HEADERS),
)
def test_any_text_ends_well(
    tmp_path: Path, lines: list[list[str]], separator: str, format: str | None, header: str
) -> None:
    ends_well(written(tmp_path, header + "\n".join(separator.join(cells) for cells in lines)), format)


def nested(inner: st.SearchStrategy[object]) -> st.SearchStrategy[object]:
    keys = st.sampled_from(["duration_ms", "bandwidth_kbps", "x"])
    return st.lists(inner, max_size=3) | st.dictionaries(keys, inner, max_size=3)


SCALARS = st.none() | st.booleans() | st.integers(-5, 10**20) | st.floats() | st.text(max_size=3)
JSON = st.recursive(SCALARS, nested, max_leaves=12)


@settings(max_examples=max(100, COUNT // 20), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=st.lists(JSON, max_size=4))
def test_any_json_ends_well(tmp_path: Path, content: list[object]) -> None:
    ends_well(written(tmp_path, json.dumps(content), "x.json"), None)


@settings(max_examples=max(150, COUNT // 20), suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    data=st.binary(max_size=60),
    format=st.sampled_from([None, *FORMATS]),
    magic=st.sampled_from([b"", b"\x1f\x8b", b"PK\x03\x04", b"PK\x05\x06", b"["]),
)
def test_any_bytes_end_well(tmp_path: Path, data: bytes, format: str | None, magic: bytes) -> None:
    ends_well(written(tmp_path, magic + data), format)
