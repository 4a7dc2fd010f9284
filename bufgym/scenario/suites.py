"""Benchmark suites: frozen, versioned sets of episodes that results are quoted on.

A suite has scenarios, capacities, and episodes in three splits: ``train`` to learn from, ``validation`` to choose
parameters by, ``test`` to report. Splits share no bandwidth trace and no motion recording (no length T, where there is
one interruption): a policy that knows a trace by heart gains nothing elsewhere. A suite never changes; what is better
gets the next version.

Messages of one suite have equal sizes, so that the clairvoyant's bound is exact.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bufgym.errors import BufgymError
from bufgym.model import qoi
from bufgym.model.qoi import Value
from bufgym.scenario import Client, Interruption, Scenario, Uplink, robofleet_example
from bufgym.traces import Motion, Trace, drive_motion, markov_link, read_motion, read_trace, synthetic_lte
from bufgym.traces.generate.lte import LTE_MODES

SPLITS = ("train", "validation", "test")

CAPACITIES = (5, 10, 15, 20, 25)
"""L of AFR's evaluation (Fig. 7, 8)."""

RATE_HZ = 30.0
SIZE_BYTES = 230_000
"""AFR's RGB-D frames: about 200 kB of depth and a JPEG."""
DEMAND_BYTES_PER_S = RATE_HZ * SIZE_BYTES
EPISODE_S = 60.0


# Made when first asked for: a Value is checked with compiled code, whose loading has no place in ``bufgym list``.


@functools.cache
def time_value() -> Value:
    """V over frame indices, as in AFR's Fig. 5."""
    return qoi.exponential(0.618)


@functools.cache
def motion_value() -> Value:
    """V = 1 - exp(-motion), over fields of view."""
    return qoi.exponential(math.exp(-1))


@dataclass(frozen=True)
class Setting:
    """One scenario of a suite."""

    scenario: Scenario
    about: str
    outage_s: float | None = None
    """Length of the episode's one blackout, where it has one."""


@dataclass(frozen=True)
class Suite:
    """One suite; ``settings`` builds its scenarios for a split."""

    name: str
    about: str
    build: Callable[[str, Path | None], dict[str, Setting]]
    capacities: tuple[int, ...] = CAPACITIES
    seeds: int = 5
    """Episodes a trace."""
    needs: str = ""
    """What a folder of recordings must hold; empty if the suite brings all it needs."""

    def settings(self, split: str, data: str | Path | None = None) -> dict[str, Setting]:
        """Label -> setting, for one split; ``data``: the folder of recordings, for suites that need one."""
        if split not in SPLITS:
            raise BufgymError(f"split = {split!r}: must be one of {', '.join(SPLITS)}")
        if self.needs and data is None:
            raise BufgymError(f"suite {self.name} needs a folder of recordings (--data DIR) with {self.needs}")
        return _settings(self.name, split, None if data is None else Path(data))


@functools.lru_cache(maxsize=16)
def _settings(name: str, split: str, data: Path | None) -> dict[str, Setting]:
    return get(name).build(split, data)


def get(name: str) -> Suite:
    """The suite of that name."""
    if name in FLEET_SUITES:
        raise BufgymError(f"suite {name} has many robots: bufgym fleet --suite {name}")
    known = SUITES | TOPIC_SUITES
    if name not in known:
        raise BufgymError(f"unknown suite {name!r}; known: {', '.join(known)}")
    return known[name]


# --- made-up links ---------------------------------------------------------------------------------------------------

_FIRST_SEED = {"train": 1000, "validation": 2000, "test": 3000}
"""Seeds of generated traces and motions count up from here; shipped ones have 0..7."""

_TRACES = {"train": 24, "validation": 6, "test": 12}


def _motions(split: str, count: int = 4) -> tuple[Motion, ...]:
    return tuple(drive_motion(_FIRST_SEED[split] + k) for k in range(count))


def _both_values(
    traces: Sequence[Trace], motions: tuple[Motion, ...], size_bytes: int = SIZE_BYTES, suffix: str = ""
) -> dict[str, Setting]:
    """The same links, once with time-based and once with motion-based QoI."""
    about = f"{RATE_HZ:g} messages/s of {size_bytes / 1000:g} kB for {EPISODE_S:g} s"
    timed = Uplink(
        traces=tuple(traces), rate_hz=RATE_HZ, size_bytes=size_bytes, duration_s=EPISODE_S, value=time_value()
    )
    return {
        f"time{suffix}": Setting(timed, f"{about}; x is the frame index"),
        f"motion{suffix}": Setting(
            replace(timed, motion=motions, value=motion_value()),
            f"{about}; x is the camera's motion, in fields of view",
        ),
    }


def _both_sizes(traces: Sequence[Trace], motions: tuple[Motion, ...]) -> dict[str, Setting]:
    """Both values, once with AFR's frames and once with large ones."""
    return _both_values(traces, motions, 230_000, "-230kB") | _both_values(traces, motions, 900_000, "-900kB")


def _lte(split: str, data: Path | None) -> dict[str, Setting]:
    """Means of 3, 5, 7 and 9 MB/s around the demand of 6.9 MB/s, in turn; modes likewise."""
    first, modes = _FIRST_SEED[split], list(LTE_MODES)
    traces = [
        synthetic_lte(first + k, mean_bytes_per_s=(3e6, 5e6, 7e6, 9e6)[k % 4], mode=modes[k % 3])
        for k in range(_TRACES[split])
    ]
    return _both_values(traces, _motions(split))


_MOVING = ("foot", "bicycle", "bus", "tram", "train", "car")


def _generated(split: str, data: Path | None) -> dict[str, Setting]:
    """The settings of lte-belgium-v1 over links and motions that are made up; the ways of moving in turn."""
    traces = [markov_link(_MOVING[k % 6], _FIRST_SEED[split] + k) for k in range(_TRACES[split])]
    return _both_sizes(traces, _motions(split))


OUTAGES_S = (5, 10, 20, 40, 60)
_AROUND_S = 60
"""Of link before and after the blackout."""


def _outage(split: str, data: Path | None) -> dict[str, Setting]:
    settings = {}
    for outage_s in OUTAGES_S:
        traces = [_blackout(_FIRST_SEED[split] + k, outage_s) for k in range(_TRACES[split] // 3)]
        settings[f"outage-{outage_s}s"] = Setting(
            Uplink(
                traces=tuple(traces),
                motion=_motions(split),
                rate_hz=RATE_HZ,
                size_bytes=SIZE_BYTES,
                duration_s=float(outage_s + _AROUND_S),
                link_offset_s=(0.0, 10.0),
                value=motion_value(),
            ),
            f"one blackout of {outage_s} s within {outage_s + _AROUND_S} s; x is the camera's motion",
            float(outage_s),
        )
    return settings


def _blackout(seed: int, outage_s: int) -> Trace:
    """A good LTE link (mean 12 MB/s) of 75 s that stands still from its 30th second on for ``outage_s`` seconds."""
    lengths_us, rates = synthetic_lte(seed, _AROUND_S + 15, mean_bytes_per_s=12e6).samples()
    steps = [(float(us) / 1e6, float(rate)) for us, rate in zip(lengths_us, rates, strict=True)]
    return Trace.steps([*steps[:30], (float(outage_s), 0.0), *steps[30:]], name=f"blackout-{outage_s}s-{seed}")


SHARES = {"quarter": 0.25, "half": 0.5, "three-quarters": 0.75}
_SHIFT = {"train": 0.0, "validation": 1 / 3, "test": 5 / 6}
"""In steps of a split's own spacing; chosen so that no rate of one split is a rate of another."""


def _sustained(split: str, data: Path | None) -> dict[str, Setting]:
    """Steady links; those of one split lie up to 6 % around the named share of the demand, each elsewhere."""
    first, count = _FIRST_SEED[split], _TRACES[split] // 3
    settings: dict[str, Setting] = {}
    for label, share in SHARES.items():
        traces = [
            Trace.constant(
                share * (0.94 + 0.12 * (k + _SHIFT[split]) / count) * DEMAND_BYTES_PER_S,
                300.0,
                name=f"steady-{label}-{first + k}",
            )
            for k in range(count)
        ]
        settings |= _both_values(traces, _motions(split), suffix=f"-{label}")
    return settings


def _interruption(split: str, data: Path | None) -> dict[str, Setting]:
    """T up to 400; lengths with T mod 5 = 3 are for validation, 4 for testing, the others for training."""
    rests = {"train": (0, 1, 2), "validation": (3,), "test": (4,)}[split]
    lengths = tuple(T for T in range(1, 401) if T % 5 in rests)
    values: dict[str, Value] = {
        "exponential-0.618": time_value(),
        "exponential-0.9": qoi.exponential(0.9),
        "saturating-8": qoi.saturating(8),
    }
    return {
        label: Setting(
            Interruption(lengths=lengths, value=v),
            f"one interruption of T messages, T log-uniform on 1..400 with T mod 5 in {rests}; V = {v.name}",
        )
        for label, v in values.items()
    }


# --- many topics -----------------------------------------------------------------------------------------------------

_DROPOUT_S = (3.0, 20.0)
_BETWEEN_DROPOUTS_S = 45.0


def _with_dropouts(trace: Trace, seed: int) -> Trace:
    """The same link, but it stands still now and then: dropouts of 3 to 20 s, one in 45 s on average."""
    rng = np.random.default_rng(seed)
    lengths_us, rates = trace.samples()
    steps: list[tuple[float, float]] = []
    left_s = float(rng.exponential(_BETWEEN_DROPOUTS_S))
    for us, rate in zip(lengths_us, rates, strict=True):
        steps.append((float(us) / 1e6, float(rate)))
        left_s -= float(us) / 1e6
        if left_s <= 0:
            steps.append((float(np.exp(rng.uniform(*np.log(_DROPOUT_S)))), 0.0))
            left_s = float(rng.exponential(_BETWEEN_DROPOUTS_S))
    return Trace.steps(steps, name=f"{trace.name}-dropouts")


CLIENT_MEANS = {"scarce": 0.5e6, "half": 1.2e6, "ample": 2.5e6}
"""Bytes/s of the link while it is up; the example client wants 2.8 MB/s once rates are limited."""
CLIENT_WINDOWS = {"": 1, "-window-5": 5}
"""n_T of Robofleet's experiments, where a pong may take longer than a message, and of its released client."""


def _topics(split: str, data: Path | None) -> dict[str, Setting]:
    """Robofleet's example client over LTE links with dropouts, at three mean capacities and two n_T."""
    first, modes = _FIRST_SEED[split], list(LTE_MODES)
    settings = {}
    for number, (label, mean) in enumerate(CLIENT_MEANS.items()):
        seeds = [first + 100 * number + k for k in range(_TRACES[split] // 2)]
        links = [
            _with_dropouts(synthetic_lte(seed, mean_bytes_per_s=mean, mode=modes[k % 3]), seed)
            for k, seed in enumerate(seeds)
        ]
        client = Client(robofleet_example(), tuple(links), _motions(split), duration_s=EPISODE_S)
        for suffix, window in CLIENT_WINDOWS.items():
            about = f"Robofleet's example client over LTE with dropouts, {mean / 1e6:g} MB/s, n_T = {window}"
            settings[label + suffix] = Setting(replace(client, window=window), about)
    return settings


# --- recordings ------------------------------------------------------------------------------------------------------

_TUM = {
    "train": ("freiburg1_desk", "freiburg1_xyz", "freiburg2_desk"),
    "validation": ("freiburg1_desk2",),
    "test": ("freiburg1_rpy", "freiburg2_pioneer_360"),
}

_BELGIUM = {
    "validation": ("foot_0003", "bus_0002", "bus_0010", "car_0004", "tram_0004"),
    "test": (
        "foot_0005",
        "foot_0006",
        "bus_0001",
        "bus_0005",
        "bus_0009",
        "car_0002",
        "car_0005",
        "tram_0002",
        "tram_0005",
        "train_0002",
    ),
    "train": (
        "bicycle_0001",
        "foot_0001",
        "foot_0007",
        "foot_0008",
        "bus_0004",
        "bus_0006",
        "bus_0007",
        "bus_0011",
        "car_0003",
        "car_0006",
        "car_0007",
        "tram_0003",
        "tram_0006",
        "tram_0007",
        "train_0001",
    ),
}


def _tum(split: str, data: Path) -> tuple[Motion, ...]:
    return tuple(read_motion(_there(data / f"tum_rgbd/{name}.groundtruth.txt.gz")) for name in _TUM[split])


def _there(path: Path) -> Path:
    if not path.exists():
        raise BufgymError(f"{path}: no such file; this suite needs it")
    return path


def _belgium(split: str, data: Path | None) -> dict[str, Setting]:
    assert data is not None
    traces = [read_trace(_there(data / f"belgium_4g/csv/report_{name}.csv")) for name in _BELGIUM[split]]
    return _both_sizes(traces, _tum(split, data))


_MOST_TRACES = 12
"""Recordings a split; where a folder holds more, evenly spaced ones in the order of their names."""


def _recorded(pattern: str, size_bytes: int) -> Callable[[str, Path | None], dict[str, Setting]]:
    """A suite over all files of a pattern: of each five in the order of their names, three train, one each the rest."""

    def build(split: str, data: Path | None) -> dict[str, Setting]:
        assert data is not None
        names = sorted(path for path in data.glob(pattern) if not path.name.startswith(("README", "LICENSE", "copy")))
        rests = {"train": (0, 1, 2), "validation": (3,), "test": (4,)}[split]
        chosen = [path for k, path in enumerate(names) if k % 5 in rests]
        if not chosen:
            raise BufgymError(f"{data / pattern}: holds {len(names)} recordings; this suite needs at least 5")
        step = max(1, math.ceil(len(chosen) / _MOST_TRACES))
        return _both_values([read_trace(path) for path in chosen[::step]], _tum(split, data), size_bytes)

    return build


_WITH_TUM = "and tum_rgbd/*.groundtruth.txt.gz"

SUITES = {
    suite.name: suite
    for suite in (
        Suite(
            "interruption-v1",
            "one interruption of unknown length (AFR paper, Sec. III-B)",
            _interruption,
            capacities=(4, 5, 8, 10, 15, 16, 20, 25, 32),
            seeds=200,
        ),
        Suite("lte-v1", "30 Hz camera over synthetic LTE links", _lte),
        Suite("outage-v1", "one blackout of 5 to 60 s on a good link", _outage),
        Suite("sustained-v1", "steady links of a quarter, half and three quarters of the demand", _sustained),
        Suite("generated-v1", "30 Hz camera over links generated like recordings of six ways of moving", _generated),
        Suite(
            "lte-belgium-v1",
            "30 Hz camera over the Belgium 4G logs with TUM RGB-D motion",
            _belgium,
            needs=f"belgium_4g/csv/*.csv {_WITH_TUM}",
        ),
        Suite(
            "lumos5g-v1",
            "30 Hz camera over Lumos5G's 4G traces with TUM RGB-D motion",
            _recorded("lumos5g/4G/*", SIZE_BYTES),
            needs=f"lumos5g/4G/* {_WITH_TUM}",
        ),
        Suite(
            "norway-hsdpa-v1",
            "30 Hz camera of 8 kB frames over the Norway HSDPA logs with TUM RGB-D motion",
            _recorded("norway_hsdpa/cooked/*", 8_000),
            needs=f"norway_hsdpa/cooked/* {_WITH_TUM}",
        ),
        Suite(
            "mahimahi-v1",
            "30 Hz camera of 30 kB frames over Mahimahi's cellular traces with TUM RGB-D motion",
            _recorded("mahimahi/*.gz", 30_000),
            needs=f"mahimahi/*.gz {_WITH_TUM}",
        ),
    )
}

TOPIC_SUITES = {
    suite.name: suite
    for suite in (
        Suite("topics-v1", "Robofleet's example client, 8 topics, over LTE with dropouts", _topics, capacities=(32,)),
    )
}
"""Suites whose episodes have several topics: another benchmark (``bufgym topics``), no clairvoyant is known there."""


# --- many robots -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FleetSuite:
    """Frozen episodes of a fleet (``bufgym.sim``): what meets each robot is a setting of a suite with one robot."""

    name: str
    about: str
    of: str
    """That suite; its splits are the fleet's."""
    setting: str
    robots: int
    capacities: tuple[int, ...]
    seeds: int
    """Episodes a trace."""

    def uplink(self, split: str) -> Uplink:
        """What each robot would meet if it had a cell for itself."""
        found = get(self.of).settings(split)[self.setting].scenario
        assert isinstance(found, Uplink)
        return found


FLEET_SUITES = {
    suite.name: suite
    for suite in (
        FleetSuite(
            "fleet-v1",
            "16 robots share a cell; 30 Hz camera over synthetic LTE links, x is each camera's motion",
            of="lte-v1",
            setting="motion",
            robots=16,
            capacities=(5, 10, 20),
            seeds=5,
        ),
    )
}
"""Suites of many robots (``bufgym fleet``)."""
