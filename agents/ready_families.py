"""Fourteen families of links and streams, which one agent learns side by side.

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


def _task(split: str) -> list[Cell]:
    on = Environment()
    return [Cell("", split_scenario(on)[split == "test"], on.capacity)]


def _frames(split: str, capacities: Sequence[int] = (3, 4, 5, 8, 12, 16, 24, 32, 48, 100, 200)) -> list[Cell]:
    first = FIRST_SEED[split]
    scenario = frames_over(range(first, first + FRAMES[split]))
    return [Cell("", scenario, L) for L in capacities]


def _kind(cell: Cell) -> str:
    """Which of the families of random streams has this one: what the clairvoyant says of it decides."""
    if cell.scenario.sizes != "equal":  # type: ignore[attr-defined]
        return "random-unequal"
    is_hopeful = cell.label.startswith("constant") or cell.scenario.value.name.startswith("saturating")
    return "random-plain" if is_hopeful else "random"


@functools.cache
def _streams(split: str) -> list[Cell]:
    return [random_stream(FIRST_SEED[split] + k) for k in range(STREAMS[split])]


def _random(split: str, kind: str, most: int = 96) -> list[Cell]:
    return [cell for cell in _streams(split)[:most] if _kind(cell) == kind]


def _short(split: str) -> list[Cell]:
    """Queues of one and of two places, under random streams and at the default frames."""
    streams = _streams(split)[: STREAMS[split] // 4]
    found = [Cell(cell.label, cell.scenario, 1 + k % 2) for k, cell in enumerate(streams)]
    return [*found, *_frames(split, (1, 2))]


def _of_suite(
    suite: str, capacities: Sequence[int], label: str = "", equal: bool = True
) -> Callable[[str], list[Cell]]:
    """Cells of a suite whose label has this in it, without a limit on bytes."""

    def made(split: str) -> list[Cell]:
        found = {name: s for name, s in suites.get(suite).settings(split).items() if label in name}
        kept = {name: s.scenario for name, s in found.items() if s.max_bytes is None}
        chosen = {name: s for name, s in kept.items() if (getattr(s, "sizes", "equal") == "equal") == equal}
        return [Cell(name, scenario, L) for name, scenario in chosen.items() for L in capacities]

    return made


FAMILIES: dict[str, Callable[[str], list[Cell]]] = {
    "task": _task,
    "frames": _frames,
    "lte": _of_suite("lte-v2", (5, 8, 15)),
    "generated": _of_suite("generated-v2", (5, 15)),
    "outage": _of_suite("outage-v1", (5, 15)),
    "heavy": _of_suite("jpeg-v1", (5, 10, 25), "heavy"),
    "light": _of_suite("jpeg-v1", (5, 10, 25), "light"),
    "interruption": _of_suite("interruption-v1", (1, 2, 5, 8, 16, 32)),
    "steady": _of_suite("sustained-v1", (1, 2, 3, 5, 8, 15, 32, 64)),
    "random": functools.partial(_random, kind="random"),
    "unequal": _of_suite("jpeg-v1", (5, 10, 25), equal=False),
    "random-unequal": functools.partial(_random, kind="random-unequal", most=48),
    "random-short": _short,
    "random-plain": functools.partial(_random, kind="random-plain"),
}
"""Name -> cells of a split."""
STAYING = ("interruption", "steady", "random-short", "random-plain", "unequal", "random-unequal")
"""Families in which the clairvoyant teaches nothing: there the student learns to do what the rule gap-price does.

For messages of unequal size there are no costs in hindsight. On steady links, in interruptions, in queues of one or two
places and where V saturates, accepting is free in hindsight, as the clairvoyant could still drop the right messages
later, and a student that accepts does not. ``random-plain`` has those among the random streams whose link is steady or
whose V saturates.
"""


def runs_of(family: str, split: str, most: int) -> list[Run]:
    """So many runs of a family with their bounds: links and L take turns, and each run has a seed of its own."""
    cells = [Cell(trace, part, c.capacity) for c in FAMILIES[family](split) for trace, part in by_trace(c.scenario)]
    order = np.random.default_rng(0).permutation(len(cells))
    found = [(cells[order[k % len(cells)]], FIRST_EPISODE[split] + k) for k in range(most)]
    return [run_of(cell.label, cell.scenario, seed, cell.capacity) for cell, seed in found]
