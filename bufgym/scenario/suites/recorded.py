"""Suites over recorded links and camera motion, from a folder that the user names (``--data``)."""

from __future__ import annotations

import math
from pathlib import Path

from bufgym.errors import BufgymError
from bufgym.scenario.suites.suite import Build, Setting, Suite
from bufgym.scenario.suites.synthetic import SIZE_BYTES, both_sizes, both_values
from bufgym.traces import Motion, read_motion, read_trace

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


def _belgium(split: str, data: Path | None) -> dict[str, Setting]:
    assert data is not None
    traces = [read_trace(_there(data / f"belgium_4g/csv/report_{name}.csv")) for name in _BELGIUM[split].split()]
    return both_sizes(traces, _tum(split, data))


_MOST_TRACES = 12
"""Recordings in a split; of a folder that holds more, evenly spaced ones in the order of their names."""


def _recorded(pattern: str, size_bytes: int) -> Build:
    """All files of a pattern in the order of their names: of every five, three train, one validates and one tests."""

    def build(split: str, data: Path | None) -> dict[str, Setting]:
        assert data is not None
        names = sorted(path for path in data.glob(pattern) if not path.name.startswith(("README", "LICENSE", "copy")))
        rests = {"train": (0, 1, 2), "validation": (3,), "test": (4,)}[split]
        chosen = [path for k, path in enumerate(names) if k % 5 in rests]
        if not chosen:
            raise BufgymError(f"{data / pattern}: holds {len(names)} recordings; this suite needs at least 5")
        step = max(1, math.ceil(len(chosen) / _MOST_TRACES))
        return both_values([read_trace(path) for path in chosen[::step]], _tum(split, data), size_bytes)

    return build


_WITH_TUM = "and tum_rgbd/*.groundtruth.txt.gz"

SUITES = (
    Suite(
        "lte-belgium-v1",
        "30 Hz camera over the Belgium 4G logs with TUM RGB-D motion",
        _belgium,
        needs=f"belgium_4g/csv/*.csv {_WITH_TUM}",
    ),
    *(
        Suite(
            name,
            f"30 Hz camera {over} with TUM RGB-D motion",
            _recorded(pattern, size_bytes),
            needs=f"{pattern} {_WITH_TUM}",
        )
        for name, over, pattern, size_bytes in (
            ("lumos5g-v1", "over Lumos5G's 4G traces", "lumos5g/4G/*", SIZE_BYTES),
            ("norway-hsdpa-v1", "of 8 kB frames over the Norway HSDPA logs", "norway_hsdpa/cooked/*", 8_000),
            ("mahimahi-v1", "of 30 kB frames over Mahimahi's cellular traces", "mahimahi/*.gz", 30_000),
        )
    ),
)
