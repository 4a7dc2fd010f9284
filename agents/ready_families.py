"""Nine families of links and streams, which one agent learns side by side.

``train.py hindsight --families all`` learns from their train splits, chooses by their validation splits, and reports on
their test splits. The splits share no link, but for ``task``: its validation has other episodes on the training links.
Each run of a split has a seed of its own, so no two have one motion, offset and jitter.

The test of the agent that ships (``studies.families``) has links of the test splits and new ones, and seeds and drives
of its own: whatever validation chooses by is kept apart from it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from agents.families import Run, run_of
from agents.held_out import split_scenario
from agents.mixed_env import Cell
from agents.tasks import Environment
from bufgym.model import qoi
from bufgym.scenario import Uplink, suites
from bufgym.scenario.numbered import by_trace
from bufgym.scenario.uplink import uplink_over_lte
from bufgym.traces import Trace, drive_motion, markov_link, synthetic_lte

MOVING = ("foot", "bicycle", "bus", "tram", "train", "car")
FIRST_SEED = {"train": 20_000, "validation": 21_000, "test": 22_000}
"""Seeds of links made here count up from these."""
UPLINKS = ("uplink-5g-v1", "uplink-wifi-v1", "uplink-mmwave-v1")
"""Suites over recorded uplinks."""
FRAMES = {"train": 96, "validation": 24, "test": 48}
"""Generated links at the default frames."""
STREAMS = {"train": 96, "validation": 48, "test": 96}
"""Streams of random conditions; three in four have messages of equal size."""
FIRST_EPISODE = {"validation": 100_000, "test": 200_000}
"""Seeds of a split's runs count up from these."""


def frames_over(seeds: Iterable[int]) -> Uplink:
    """The default frames of 4.6 MB over generated links of six ways of moving."""
    seeds = list(seeds)
    links = tuple(markov_link(MOVING[seed % 6], seed) for seed in seeds)
    return replace(uplink_over_lte(), traces=links, motion=tuple(drive_motion(seed) for seed in seeds))


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


def random_stream(seed: int) -> Cell:
    """Rate, size, load, link, L, V and law of sizes, all at random; the label is the link's name."""
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
    return Cell(link.name, scenario, L)


def _task(split: str, data: str | None = None) -> list[Cell]:
    on = Environment()
    return [Cell("", split_scenario(on)[split == "test"], on.capacity)]


def _frames(split: str, data: str | None = None) -> list[Cell]:
    first = FIRST_SEED[split]
    scenario = frames_over(range(first, first + FRAMES[split]))
    return [Cell("", scenario, L) for L in (3, 4, 5, 8, 12, 16, 24, 32, 48, 100, 200)]


def _is_taught(cell: Cell) -> bool:
    """Whether a network decides there at all; otherwise it leaves all to the rule."""
    is_left = cell.label.startswith("constant") or cell.scenario.value.name.startswith("saturating")
    return cell.scenario.sizes == "equal" and not is_left and cell.capacity > 2  # type: ignore[attr-defined]


@functools.cache
def _random(split: str, data: str | None = None) -> list[Cell]:
    streams = (random_stream(FIRST_SEED[split] + k) for k in range(STREAMS[split]))
    return [cell for cell in streams if _is_taught(cell)]


def _uplinks(split: str, data: str | None = None) -> list[Cell]:
    """Recorded uplinks; where no folder has recordings, there are none."""
    names = UPLINKS if data else ()
    return [cell for name in names for cell in _of_suite(name, (5, 15))(split, data)]


def _of_suite(suite: str, capacities: Sequence[int], label: str = "") -> Callable[..., list[Cell]]:
    """Cells of a suite whose label has this in it, with messages of equal size and no limit on bytes."""

    def made(split: str, data: str | None = None) -> list[Cell]:
        found = {name: s for name, s in suites.get(suite).settings(split, data).items() if label in name}
        kept = {name: s.scenario for name, s in found.items() if s.max_bytes is None}
        chosen = {name: _moved(s, split) for name, s in kept.items() if getattr(s, "sizes", "equal") == "equal"}
        return [Cell(name, scenario, L) for name, scenario in chosen.items() for L in capacities]

    return made


def _moved(scenario: Any, split: str) -> Any:
    """With many drives in place of a suite's few, where it trains: a network sees how its camera moves."""
    is_made_up = all(motion.name.startswith("drive") for motion in getattr(scenario, "motion", ()))
    if split != "train" or not getattr(scenario, "motion", ()) or not is_made_up:
        return scenario
    return replace(scenario, motion=frames_over(range(FIRST_SEED[split], FIRST_SEED[split] + FRAMES[split])).motion)


FAMILIES: dict[str, Callable[..., list[Cell]]] = {
    "task": _task,
    "frames": _frames,
    "lte": _of_suite("lte-v2", (5, 8, 15)),
    "generated": _of_suite("generated-v2", (5, 15)),
    "outage": _of_suite("outage-v1", (5, 15)),
    "heavy": _of_suite("jpeg-v1", (5, 10, 25), "heavy"),
    "light": _of_suite("jpeg-v1", (5, 10, 25), "light"),
    "random": _random,
    "uplinks": _uplinks,
}
"""Name -> cells of a split, with a folder of recordings for ``uplinks``."""


def runs_of(family: str, split: str, most: int, data: str | None = None) -> list[Run]:
    """So many runs of a family with their bounds: links and L take turns, and each run has a seed of its own."""
    cells = [
        Cell(trace, part, c.capacity) for c in FAMILIES[family](split, data) for trace, part in by_trace(c.scenario)
    ]
    order = np.random.default_rng(0).permutation(len(cells))
    found = [(cells[order[k % len(cells)]], FIRST_EPISODE[split] + k) for k in range(most)]
    return [run_of(cell.label, cell.scenario, seed, cell.capacity) for cell, seed in found]
