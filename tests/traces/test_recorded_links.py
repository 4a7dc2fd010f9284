"""Every recorded link agrees with STATS.csv of the recorded data: duration, mean, seconds under 500 KB/s, and the rest.

The table has KB/s of 1000 B, one decimal, and the least rate among samples at least half as long as the median one,
as `describe` does. Where it goes by another rule than the reader, the difference is stated here. The recorded uplinks
are read by the test of the committed fits.
"""

import csv
import gzip
from pathlib import Path

import numpy as np
import pytest

from bufgym.traces import Trace, describe, read_trace
from bufgym.traces.datasets.unpack import unpack

SETS = {
    "belgium_4g": ("belgium_4g/csv/*.csv", "csv", 30),
    "belgium_4g raw": ("belgium_4g/raw/*.log", "belgium", 5),
    "belgium_4g sabre": ("belgium_4g/sabre_json/*.json", "sabre", 30),
    "norway_hsdpa": ("norway_hsdpa/cooked/*", "mbit", 80),
    "lumos5g_4G": ("lumos5g/4G/*", "mbit", 175),
    "solis_wifi": ("solis_wifi/*.txt", "mbit", 80),
}
ROUNDING = 0.051
"""The table gives one decimal, so half a tenth and a little for its rounding of exact ties."""
# How far a data set's rule may put them apart: rates in KB/s, min and max and mean relative to theirs, and s.
#   solis_wifi: the table takes each line as 1 s, we go by the times in the file, which jitter.
#   sabre: whole kbit/s, cut off, so up to 0.125 KB/s less.
LOOSER = {"solis_wifi": (0.0, 0.01, 4e-3, 0.6), "belgium_4g sabre": (0.125, 0.0, 0.0, 0.0)}
# Two Solis files whose only zeros are lines with the same time as the next one.
LEAST_WITHOUT_LINES_OF_NO_LENGTH = {"wifi_cafe_231115-154511": 45.0, "wifi_restr_231115-134450": 42.5}


def compare(shared_data: Path, data_set: str, traces: dict[str, Trace], looser: tuple[float, ...] = (0,) * 4) -> None:
    rates, extremes, mean, s = looser
    with open(shared_data / "STATS.csv", newline="") as file:
        rows = {row.pop("trace"): row for row in csv.DictReader(file) if row.pop("set") == data_set}
    for name, trace in traces.items():
        summary, expected = describe(trace), {key: float(value) for key, value in rows[name].items()}
        expected["min_KBps"] = LEAST_WITHOUT_LINES_OF_NO_LENGTH.get(name, expected["min_KBps"])
        assert set(summary) == set(expected)
        for key, value in expected.items():
            relative = {"mean_KBps": mean, "min_KBps": extremes, "max_KBps": extremes}.get(key, 0.0)
            absolute = ROUNDING + (rates if key.endswith("KBps") and key[0] == "m" else s)
            assert summary[key] == pytest.approx(value, rel=relative, abs=absolute), (trace.source, key)


NIGHTLY = [pytest.param(name, marks=pytest.mark.nightly) for name in SETS if "raw" not in name]


@pytest.mark.parametrize("name", ["belgium_4g raw", *NIGHTLY])
def test_recorded_links_agree_with_the_table(shared_data: Path, name: str) -> None:
    pattern, format, count = SETS[name]
    paths = sorted(shared_data.glob(pattern))
    traces = {trace.name: trace for trace in map(read_trace, paths)}
    assert len(traces) == count and all(f"format {format}, detected" in trace.source for trace in traces.values())
    compare(shared_data, name.split()[0], traces, LOOSER.get(name, (0,) * 4))
    if format == "belgium":  # a raw log and its CSV are one trace
        for path in paths:
            assert read_trace(path) == read_trace(shared_data / "belgium_4g" / "csv" / f"{path.stem}.csv")


@pytest.mark.nightly
def test_every_file_of_the_ucc_archive(shared_data: Path, tmp_path: Path) -> None:
    unpack(shared_data / "ucc_5g" / "5G-production-dataset.zip", tmp_path / "ucc")
    traces = {str(path): read_trace(path) for path in (tmp_path / "ucc").rglob("*.csv")}
    downloads = {"/".join(m.split("/")[-2:]): trace for m, trace in traces.items() if "/Download/" in m}
    assert len(traces) == 83 and len(downloads) == 21
    compare(shared_data, "ucc_5g_download", downloads)
    for path in (shared_data / "mahimahi").glob("*.gz"):
        assert read_trace(path).total_bytes == 1500 * len(gzip.decompress(path.read_bytes()).split())


def test_car_0002_fades_in_its_seconds_21_and_23(shared_data: Path) -> None:
    """The trace of the AFR paper's evaluation (490.2 and 222.3 KB/s, by the README of the data)."""
    _, rates = read_trace(shared_data / "belgium_4g" / "csv" / "report_car_0002.csv").segments()
    assert np.flatnonzero(rates < 500_000).tolist() == [21, 23, 73, 82, 128, 157, 294, 296, 395]
    assert (rates[[21, 23]] / 1e3).round(1).tolist() == [490.2, 222.3]
