"""stress-v1: conditions that nobody trained on, each in a scenario of its own, for the worst cell of every policy.

Other suites measure a policy where a robot usually is; this one asks whether it is safe elsewhere. Episodes are short
and few, because a factor of two matters here, not a per cent.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from bufgym.model import qoi
from bufgym.scenario.suites.suite import Setting, Suite
from bufgym.scenario.suites.synthetic import (
    FIRST_SEED,
    RATE_HZ,
    SIZE_BYTES,
    motion_value,
    motions_of,
    steady_links,
    time_value,
)
from bufgym.scenario.uplink import Uplink
from bufgym.traces import Motion, Trace, Workload, synthetic_lte

CAPACITIES = (1, 2, 3, 15, 64, 200)
"""Values of L far from those of the other suites, and one of theirs."""

_TRACES = 2
_MESSAGES = 600
_FADING = 0.3  # mean of a fading link, as a share of the demand

_TABLE = "tabulated:0=0,2=0.5,10=0.8,60=1"
"""V over frame indices with corners: half of the view is new after 2 frames, all of it after 60."""
_MOTION_TABLE = "tabulated:0=0,0.05=0.4,0.5=0.7,3=1"  # the same over fields of view


def _fading(split: str, demand_bytes_per_s: float, share: float = _FADING) -> tuple[Trace, ...]:
    """Links of a driving robot over LTE."""
    mean = share * demand_bytes_per_s
    return tuple(synthetic_lte(FIRST_SEED[split] + k, mean_bytes_per_s=mean) for k in range(_TRACES))


def _both(label: str, about: str, split: str, max_bytes: int | None = None, **changes: Any) -> dict[str, Setting]:
    """The stream once with time-based and once with motion-based QoI; by default over a fading link."""
    rate_hz, size_bytes = changes.get("rate_hz", RATE_HZ), changes.get("size_bytes", SIZE_BYTES)
    changes = {"traces": _fading(split, rate_hz * size_bytes), "duration_s": _MESSAGES / rate_hz, **changes}
    timed = Uplink(**{"rate_hz": RATE_HZ, "size_bytes": SIZE_BYTES, "value": time_value(), **changes})
    moving = replace(timed, motion=motions_of(split, _TRACES), value=motion_value())
    return {
        f"{label}-time": Setting(timed, f"{about}; x is the frame index", max_bytes=max_bytes),
        f"{label}-motion": Setting(moving, f"{about}; x is the camera's motion", max_bytes=max_bytes),
    }


def _valued(split: str) -> dict[str, Setting]:
    """Other V over a fading link; if V saturates after n frames, the link carries one in n on average."""
    timed, moving = (setting.scenario for setting in _both("", "", split).values())
    settings = {}
    for frames in (4, 8, 16, 32):
        links = _fading(split, RATE_HZ * SIZE_BYTES, 1 / frames)
        scenario = replace(timed, traces=links, value=qoi.saturating(frames))
        about = f"V = saturating-{frames} over frame indices, a fading link that carries one frame in {frames}"
        settings[f"saturating-{frames}-time"] = Setting(scenario, about)
    for label, scenario, table in (("time", timed, _TABLE), ("motion", moving, _MOTION_TABLE)):
        about = f"V = a table with corners; {label}, a fading link"
        settings[f"tabulated-{label}"] = Setting(replace(scenario, value=qoi.parse(table)), about)
    return settings


def _arrivals(split: str, kind: str) -> Workload:
    """Bursts of ten within 10 ms, or a Poisson process; 30 messages a second on average."""
    rng = np.random.default_rng(FIRST_SEED[split])
    if kind == "poisson":
        at_s = np.cumsum(rng.exponential(1 / RATE_HZ, _MESSAGES))
    else:
        at_s = np.repeat(np.arange(_MESSAGES // 10) * 10 / RATE_HZ, 10) + np.tile(np.arange(10) * 1e-3, _MESSAGES // 10)
    arrival_us = np.rint((at_s - at_s[0]) * 1e6).astype(np.int64)
    return Workload(f"{kind}-{split}", arrival_us, np.full(_MESSAGES, SIZE_BYTES))


def _jumping(split: str, kind: str, every_s: float, views: float, lasting_s: float) -> Motion:
    """A camera that stands still except for moves of so many fields of view, at random times."""
    rng = np.random.default_rng(FIRST_SEED[split])
    at_s = np.cumsum(lasting_s + rng.exponential(every_s, 100))
    edges_s = np.concatenate([[0.0], np.column_stack([at_s - lasting_s, at_s]).ravel()])
    x = np.concatenate([[0.0], np.repeat(np.arange(101) * views, 2)[1:-1]])
    return Motion(f"{kind}-{split}", np.rint(edges_s * 1e6).astype(np.int64), x)


def _blackouts(split: str) -> tuple[Trace, ...]:
    """30 % more than the demand of 5 Hz, and a minute of nothing every 20 to 40 s."""
    traces = []
    for k in range(_TRACES):
        lengths_s = np.random.default_rng(FIRST_SEED[split] + k).uniform(20, 40, 4)
        steps = [step for s in lengths_s.tolist() for step in ((s, 1.3 * 5 * SIZE_BYTES), (60.0, 0.0))]
        traces.append(Trace.steps(steps, name=f"blackouts-{FIRST_SEED[split] + k}"))
    return tuple(traces)


def _stress(split: str, data: Path) -> dict[str, Setting]:
    settings = _valued(split)
    for percent in (10, 30, 50, 70, 90):
        links = steady_links(split, f"{percent}%", percent / 100, _TRACES)
        settings |= _both(f"steady-{percent}", f"a steady link of {percent} % of the demand", split, traces=links)
    for kind, about in (("bursts", "bursts of ten messages"), ("poisson", "arrivals of a Poisson process")):
        settings |= _both(kind, f"{about}, a fading link", split, workload=_arrivals(split, kind))
    streams: dict[str, dict[str, Any]] = {
        "frames-5kB": {"size_bytes": 5_000, "traces": _fading(split, RATE_HZ * 5_000, 0.6)},
        "frames-20MB": {"size_bytes": 20_000_000, "traces": _fading(split, RATE_HZ * 20_000_000, 0.02)},
        "rate-5Hz": {"rate_hz": 5.0},
        "rate-120Hz": {"rate_hz": 120.0},
    }
    for label, changes in streams.items():
        settings |= _both(label, f"{label.replace('-', ' of ')}, a fading link", split, **changes)
    _, moving = _both("", "", split).values()
    for kind, jumps in {"still": (8.0, 0.05, 0.5), "teleporting": (2.0, 3.0, 0.001)}.items():
        motion = (_jumping(split, kind, *jumps),)
        settings[f"{kind}-motion"] = Setting(replace(moving.scenario, motion=motion), f"a {kind} camera, a fading link")
    for messages in (5, 20):
        limit = messages * SIZE_BYTES + SIZE_BYTES // 2
        about = f"a byte limit of {messages} messages and a half, a fading link"
        settings |= _both(f"bytes-{messages}", about, split, max_bytes=limit)
    blackouts: dict[str, Any] = {"rate_hz": 5.0, "duration_s": 150.0, "traces": _blackouts(split)}
    return settings | _both("blackouts", "blackouts of 60 s on a good link, 5 Hz", split, **blackouts)


SUITES = (
    Suite(
        "stress-v1", "conditions that nobody trained on, by the worst cell", _stress, CAPACITIES, seeds=2, kind="stress"
    ),
)
