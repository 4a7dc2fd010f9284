"""Suites over recorded links and camera motion, from a folder that the user names (``--data``)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from bufgym.scenario.afr_evaluation import LINK, evaluation
from bufgym.scenario.suites.suite import Build, Setting, Suite
from bufgym.scenario.suites.synthetic import SIZE_BYTES, TRACES, both_sizes, both_values
from bufgym.traces import Motion, markov_link, read_motion, read_trace
from bufgym.traces.formats.logs import runs_of
from bufgym.utils.errors import BufgymError

_TUM = {
    "train": ("freiburg1_desk", "freiburg1_xyz", "freiburg2_desk"),
    "validation": ("freiburg1_desk2",),
    "test": ("freiburg1_rpy", "freiburg2_pioneer_360"),
}
"""Sequences of the TUM RGB-D data set, by split."""

_BELGIUM = {
    "train": "bicycle_0001 foot_0001 foot_0007 foot_0008 bus_0004 bus_0006 bus_0007 bus_0011 car_0003 car_0006 car_0007"
    " tram_0003 tram_0006 tram_0007 train_0001",
    "validation": "foot_0003 bus_0002 bus_0010 car_0004 tram_0004",
    "test": "foot_0005 foot_0006 bus_0001 bus_0005 bus_0009 car_0002 car_0005 tram_0002 tram_0005 train_0002",
}
"""Logs of the Belgium 4G data set, by split."""


def _tum(split: str, data: Path) -> tuple[Motion, ...]:
    return tuple(read_motion(_there(data / f"tum_rgbd/{name}.groundtruth.txt.gz")) for name in _TUM[split])


def _there(path: Path) -> Path:
    if not path.exists():
        raise BufgymError(f"{path}: no such file; this suite needs it")
    return path


def _belgium(split: str, data: Path) -> dict[str, Setting]:
    traces = [read_trace(_there(data / f"belgium_4g/csv/report_{name}.csv")) for name in _BELGIUM[split].split()]
    return both_sizes(traces, _tum(split, data))


_MOST_TRACES = 12  # most recordings in a split; a larger folder gives evenly spaced ones, in the order of their names


def _every_fifth(pattern: str, size_bytes: int) -> Build:
    """All files of a pattern, by name: of every five, three are for training, one validates and one tests."""

    def build(split: str, data: Path) -> dict[str, Setting]:
        names = sorted(path for path in data.glob(pattern) if not path.name.startswith(("README", "LICENSE", "copy")))
        rests = {"train": (0, 1, 2), "validation": (3,), "test": (4,)}[split]
        chosen = [path for k, path in enumerate(names) if k % 5 in rests]
        if not chosen:
            raise BufgymError(f"{data / pattern}: holds {len(names)} recordings; this suite needs at least 5")
        step = max(1, math.ceil(len(chosen) / _MOST_TRACES))
        return both_values([read_trace(path) for path in chosen[::step]], _tum(split, data), size_bytes)

    return build


def _by_name(pattern: str, belongs: Callable[[str, str], bool]) -> Build:
    """The files of a pattern that belong to (name, split), at most as many as other suites have traces."""

    def build(split: str, data: Path) -> dict[str, Setting]:
        paths = sorted(path for path in data.glob(pattern) if belongs(path.name, split))
        if not paths:
            raise BufgymError(f"{data / pattern}: holds no recording of the split {split}; this suite needs some")
        return both_sizes([read_trace(path) for path in _at_most(paths, TRACES[split])], _tum(split, data))

    return build


_DAYS = {"train": ("20241101", "20241102", "20241103"), "validation": ("20241104",), "test": ("20241105",)}
"""Days of the drive from Los Angeles to Boston, by split: no two splits share a day, or a place."""

_FAILED = ("20241101_170456963", "20241102_104344891", "20241103_110904624", "20241104_132730722")
"""Runs that their server ended with an error."""

_PLACES = {"train": "loc2", "validation": "loc1", "test": "loc3"}
"""Places in the shipyard, by split. loc3, with the slowest links, tests; runs that name no place are left out."""

_uplink_5g = _by_name("uplink_5g/*.out.gz", lambda name, split: name[:8] in _DAYS[split] and name[:18] not in _FAILED)
_uplink_wifi = _by_name("uplink_wifi/*_server.json.gz", lambda name, split: f"_{_PLACES[split]}_" in name)

_MMWAVE = {
    "train": ("static_5g_away_p1", "static_5g_toward_p1", "walking_5g_away"),
    "validation": ("static_5g_away_p2", "static_5g_toward_p2", "walking_5g_toward"),
    "test": ("static_5g_away_p3", "static_5g_toward_p3", "walking_5g_lateral"),
}
"""Files of runs, by split: no two share a place. Runs of 15 s (static) and 50 s (walking) begin again at their end."""


def _uplink_mmwave(split: str, data: Path) -> dict[str, Setting]:
    traces = []
    for name in _MMWAVE[split]:
        path = _there(data / f"uplink_mmwave/{name}.list.gz")
        traces += [replace(read_trace(path, column=run), name=f"{name}-{run.split()[1]}") for run in runs_of(path)]
    return both_sizes(_at_most(traces, TRACES[split]), _tum(split, data))


def _at_most(items: Sequence[Any], most: int) -> list[Any]:
    """All items, or ``most`` evenly spaced ones if there are more."""
    count = min(most, len(items))
    return [items[k * len(items) // count] for k in range(count)]


_WITH_TUM = "and tum_rgbd/*.groundtruth.txt.gz"

SUITES = tuple(
    Suite(name, f"30 Hz camera {over} with TUM RGB-D motion", build, needs=f"{pattern} {_WITH_TUM}")
    for name, over, build, pattern in (
        ("lte-belgium-v1", "over the Belgium 4G logs", _belgium, "belgium_4g/csv/*.csv"),
        ("uplink-5g-v1", "over 5G uplinks of a drive, split by day", _uplink_5g, "uplink_5g/*.out.gz"),
        ("uplink-wifi-v1", "over WiFi uplinks in a shipyard, split by place", _uplink_wifi, "uplink_wifi/*.json.gz"),
        ("uplink-mmwave-v1", "over 5G mmWave uplinks, split by place", _uplink_mmwave, "uplink_mmwave/*.list.gz"),
        *(
            (name, over, _every_fifth(pattern, size_bytes), pattern)
            for name, over, pattern, size_bytes in (
                ("lumos5g-v1", "over Lumos5G's 4G traces", "lumos5g/4G/*", SIZE_BYTES),
                ("norway-hsdpa-v1", "of 8 kB frames over the Norway HSDPA logs", "norway_hsdpa/cooked/*", 8_000),
                ("mahimahi-v1", "of 30 kB frames over Mahimahi's cellular traces", "mahimahi/*.gz", 30_000),
            )
        ),
    )
)


def _afr(split: str, data: Path) -> dict[str, Setting]:
    """To learn from there are made-up links of cars; the paper's own is the test."""
    seeds = {"train": range(6), "validation": range(6, 9)}
    links = [read_trace(_there(data / LINK))] if split == "test" else [markov_link("car", seed=k) for k in seeds[split]]
    return {"evaluation": Setting(evaluation(*links), "794 frames of 160 kB at 30 Hz, from the link's start")}


SUITES += (
    Suite("afr-evaluation-v1", "AFR's evaluation over car_0002", _afr, capacities=(5, 10, 15), seeds=10, needs=LINK),
)
