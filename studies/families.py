"""Twelve families of links and streams for one agent: its training episodes, and others to choose it by."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from agents.families import Run, merged, of_suite, run_of
from bufgym.ground.files import replaced
from bufgym.model import qoi
from bufgym.scenario import Uplink
from bufgym.scenario.numbered import by_trace
from bufgym.scenario.uplink import uplink_over_lte
from bufgym.traces import Trace, drive_motion, markov_link, synthetic_lte

MOVING = ("foot", "bicycle", "bus", "tram", "train", "car")
UPLINKS = ("uplink-5g-v1", "uplink-wifi-v1", "uplink-mmwave-v1")
"""Suites over recorded uplinks."""
FIRST_SEED = {"train": 20_000, "validation": 21_000, "test": 22_000}
"""Seeds of links made here count up from these."""


def task(split: str) -> list[Run]:
    """The task of ``make train``: its training links, at L = 8."""
    scenario = uplink_over_lte()
    parts = by_trace(replace(scenario, traces=scenario.traces[:-2]))
    first = {"train": 1000, "validation": 1500, "test": 1800}[split]
    return [run_of(trace, part, seed, 8) for trace, part in parts for seed in range(first, first + 8)]


def default_frames(split: str, count: int = 48) -> list[Run]:
    """Generated links of six ways of moving at the default frames of 4.6 MB."""
    runs = []
    for seed in range(FIRST_SEED[split], FIRST_SEED[split] + count):
        links = (markov_link(MOVING[seed % 6], seed),)
        scenario = replace(uplink_over_lte(), traces=links, motion=(drive_motion(seed),))
        runs += [run_of(links[0].name, scenario, 0, L) for L in (5, 8, 16)]
    return runs


def random_link(rng: np.random.Generator, seed: int, mean_bytes_per_s: float) -> Trace:
    """A link of one of four kinds: LTE, generated like recordings, switching, steady."""
    kind = rng.integers(4)
    if kind == 0:
        return synthetic_lte(seed, mean_bytes_per_s=mean_bytes_per_s)
    if kind == 1:
        link = markov_link(MOVING[rng.integers(6)], seed)
        return link.scaled(mean_bytes_per_s * link.duration_us / 1e6 / int(link.cumulative_bytes[-1]))
    if kind == 2:
        lengths_s = 0.2 + rng.exponential(3, 40)
        steps = [(float(s), mean_bytes_per_s * float(rng.choice([0, 0.3, 1, 2.2]))) for s in lengths_s]
        return Trace.steps([*steps, (2.0, mean_bytes_per_s)], name=f"switching-{seed}")
    return Trace.constant(mean_bytes_per_s, 300.0, name=f"constant-{seed}")


def random_streams(split: str, count: int = 120) -> list[Run]:
    """Rates, sizes, loads, links, L, V and laws of sizes, all at random."""
    runs = []
    for seed in range(FIRST_SEED[split], FIRST_SEED[split] + count):
        rng = np.random.default_rng([seed, 5])
        rate_hz, size = float(rng.choice([5, 10, 30, 60])), int(np.exp(rng.uniform(np.log(2e4), np.log(5e6))))
        load = np.exp(rng.uniform(np.log(0.04), np.log(1.1)))
        L = round(float(np.exp(rng.uniform(np.log(2), np.log(48)))))
        link, moves = random_link(rng, seed, float(load * rate_hz * size)), rng.random() < 0.6
        by_time = (
            qoi.exponential(rng.choice([0.3, 0.618, 0.9]))
            if rng.random() < 0.75
            else qoi.saturating(rng.choice([4, 8, 16]))
        )
        scenario = Uplink(
            traces=(link,),
            motion=(drive_motion(seed),) if moves else (),
            rate_hz=rate_hz,
            size_bytes=size,
            sizes=str(rng.choice(["equal", "equal", "jpeg", "gop"])),
            duration_s=min(600 / rate_hz, 60.0),
            value=qoi.exponential(float(np.exp(-rng.choice([0.3, 1, 3])))) if moves else by_time,
        )
        runs.append(run_of(link.name, scenario, 0, L))
    return runs


def families(split: str, folder: Path, data: str | None = None) -> dict[str, list[Run]]:
    """All families by name; the bounds take minutes and are kept in ``folder``.

    With ``data``, a folder of recordings, there is one more that no agent learns from: recorded uplinks.
    """
    cameras: dict[str, list[Run]] = {}

    def camera(load: str, equal: bool) -> list[Run]:
        if not cameras:
            cameras.update(of_suite("jpeg-v1", split))
        return merged(cameras, lambda label: load in label and ("equal" in label) == equal)

    makers: dict[str, Callable[[], list[Run]]] = {
        "task": lambda: task(split),
        "default-frames": lambda: default_frames(split),
        "lte": lambda: merged(of_suite("lte-v2", split, (5, 15))),
        "generated": lambda: merged(of_suite("generated-v2", split, (5, 15), every=2)),
        "outage": lambda: merged(of_suite("outage-v1", split, (5, 15), seeds=1 if split == "train" else 4)),
        "sustained": lambda: merged(of_suite("sustained-v1", split, (5, 15), seeds=1 if split == "train" else 4)),
        "interruption": lambda: merged(of_suite("interruption-v1", split, (5, 8, 16, 32), seeds=40)),
        "random": lambda: random_streams(split),
        "unequal-heavy": lambda: camera("heavy", False),
        "unequal-light": lambda: camera("light", False),
        "equal-heavy": lambda: camera("heavy", True),
        "equal-light": lambda: camera("light", True),
    }
    if data:
        makers["uplinks"] = lambda: [
            run for name in UPLINKS for run in merged(of_suite(name, split, (5, 15), data=data))
        ]
    folder.mkdir(parents=True, exist_ok=True)
    found = {}
    for name, make in makers.items():
        kept = folder / f"{split}-{name}.pkl"  # only from your own run: pickles run code when they are read
        if not kept.exists():
            with replaced(kept) as unfinished:
                unfinished.write_bytes(pickle.dumps(make()))
        found[name] = pickle.loads(kept.read_bytes())
    return found
