"""The families of links and streams by which agents for one queue are judged: no training or validation saw them.

A family is a list of *places*: a link, what is sent over it, and L. Each place has several runs, and each run a seed
of its own. The seed draws the jitter and the offset on the link. Where the camera moves by a made-up drive, the drive
is made of it, too. So runs on one link share the link alone. The scenarios of one link, such as those of two sizes,
meet the same draws.

What is kept apart from what, which ``tests/test_families.py`` checks:

- *Links.* ``train.py hindsight`` learns on the split "train" of ``agents.ready_families`` and chooses by its split
  "validation". The links here are of the split "test" of suites, the task's held-out links, or made of seeds from
  ``FIRST_LINK`` on. ``fresh`` has links of ways of moving from which no family there has a link.
- *Motion and seeds.* Runs count their seeds up from ``FIRST_RUN``; validation has those from ``FIRST_EPISODE`` of
  ``agents.ready_families`` on, and training draws at random from 2^31 seeds. Drives have seeds from ``FIRST_RUN`` on,
  those of training and validation end below it. Recorded uplinks move by the recordings of the split "test", from
  random offsets on.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agents.families import Run, bound_of, drawn_run
from agents.held_out import split_scenario
from agents.ready_families import MOVING, random_stream
from agents.tasks import Environment
from bufgym.scenario import suites
from bufgym.scenario.numbered import by_trace
from bufgym.scenario.uplink import uplink_over_lte
from bufgym.traces import drive_motion, markov_link
from bufgym.utils.errors import unknown
from bufgym.utils.files import replaced

FIRST_LINK, FIRST_RUN = 50_000, 700_000
"""Seeds of links made here, and of runs, count up from these."""
MOST_SEEDS = 16
"""Run s on the k-th link of a family has the seed ``FIRST_RUN + MOST_SEEDS k + s``."""
OTHER_WAYS = ("wifi-cafe", "wifi-campus", "wifi-office", "wifi-restr", "uplink-5g", "uplink-wifi", "uplink-mmwave")
"""Modes of ``markov_link`` of which no training family has links."""
UPLINKS = ("uplink-5g-v1", "uplink-wifi-v1", "uplink-mmwave-v1")
"""Suites over recorded uplinks."""
AT_ONCE = 128
"""Runs whose bounds are kept in one file."""
SHORT_TO_LONG = (3, 5, 8, 16, 32)


class Place(NamedTuple):
    """A stream over one link, at one L."""

    link: str
    scenario: Any
    capacity: int
    max_bytes: int | None = None


def of_suite(
    name: str,
    capacities: Iterable[int] = (),
    every: int = 1,
    data: str | None = None,
    chosen: Callable[[str], bool] = lambda label: True,
) -> list[Place]:
    """The test split of a suite on every so many of its links; ``data`` is a folder of recordings."""
    suite = suites.get(name)
    return [
        Place(trace, scenario, L, setting.max_bytes)
        for label, setting in suite.settings("test", data).items()
        if chosen(label)
        for trace, scenario in by_trace(setting.scenario)[::every]
        for L in tuple(capacities) or setting.capacities or suite.capacities
    ]


def task() -> list[Place]:
    """The sixteen links that ``train.py`` holds out of the task of ``make train``, at L = 8."""
    return [Place(trace, part, 8) for trace, part in by_trace(split_scenario(Environment())[True])]


def large_frames(ways: tuple[str, ...], links: int, capacities: Iterable[int] = SHORT_TO_LONG) -> list[Place]:
    """The default frames of 4.6 MB over generated links of these ways of moving, which take turns."""
    made = [markov_link(ways[k % len(ways)], FIRST_LINK + k) for k in range(links)]
    scenario = replace(uplink_over_lte(), traces=tuple(made))
    return [Place(trace, part, L) for trace, part in by_trace(scenario) for L in capacities]


def random_streams(count: int = 96) -> list[Place]:
    """Rates, sizes, loads, links, L and V at random; all messages of a stream are of one size."""
    found, seed = list[Place](), FIRST_LINK
    while len(found) < count:
        cell = random_stream(seed)
        if cell.scenario.sizes == "equal":  # type: ignore[attr-defined]
            found.append(Place(f"{seed}", cell.scenario, cell.capacity))
        seed += 1
    return found


def interruptions(count: int = 96) -> list[Place]:
    """Interruptions of lengths that no training has; each is a link of its own, and has one run."""
    places = of_suite("interruption-v1", (5, 8, 16, 32))
    return [place._replace(link=f"{k}") for k in range(count) for place in places]


def cameras(kind: str, *, equal: bool = True, capacities: Iterable[int] = (), every: int = 1) -> list[Place]:
    """``jpeg-v1`` where the label has ``kind`` in it, with messages of equal sizes or of the four other laws."""
    return of_suite("jpeg-v1", capacities, every, chosen=lambda label: kind in label and ("equal" in label) == equal)


def unequal() -> list[Place]:
    """Messages of four laws of unequal sizes, L = 8. The clairvoyant is a bound there, and takes a second or two."""
    places = [place for load in ("heavy", "light") for place in cameras(load, equal=False, capacities=(8,), every=4)]
    return [place for place in places if place.max_bytes is None]


class Maker(NamedTuple):
    """How a family is made."""

    places: Callable[[], list[Place]]
    seeds: int = 8
    """Runs of each place."""


FAMILIES: dict[str, Maker] = {
    "task": Maker(task),
    "frames": Maker(functools.partial(large_frames, MOVING, 36)),
    "fresh": Maker(functools.partial(large_frames, OTHER_WAYS, 35)),
    "lte": Maker(functools.partial(of_suite, "lte-v2", (5, 15)), 4),
    "generated": Maker(functools.partial(of_suite, "generated-v2", (5, 15)), 4),
    "outage": Maker(functools.partial(of_suite, "outage-v1", (5, 15))),
    "steady": Maker(functools.partial(of_suite, "sustained-v1", (5, 15))),
    "interruption": Maker(interruptions, 1),
    "random": Maker(random_streams, 4),
    "unequal": Maker(unequal, 4),
    "equal-heavy": Maker(functools.partial(cameras, "heavy"), 4),
    "equal-light": Maker(functools.partial(cameras, "light"), 4),
}
"""Families of streams over made-up links."""
BOUNDED = ("unequal",)
"""Families in which the clairvoyant's H is a bound that takes minutes: they are judged only where they are named."""


def chosen(data: str | None = None, only: Iterable[str] = ()) -> dict[str, Maker]:
    """The families of these names, by default all but ``BOUNDED``; ``data``, a folder of recordings, adds uplinks."""
    known = dict(FAMILIES)
    if data:
        known["uplinks"] = Maker(lambda: [place for name in UPLINKS for place in of_suite(name, (5, 15), data=data)], 4)
    for name in only:
        if name not in known:
            raise unknown("family", name, known)
    return {name: known[name] for name in only or [name for name in known if name not in BOUNDED]}


def drawn(maker: Maker) -> list[Run]:
    """All runs of a family, without their bounds."""
    places = maker.places()
    number = {link: k for k, link in enumerate(dict.fromkeys(place.link for place in places))}
    return [
        drawn_run(place.link, moved(place.scenario, seed), seed, place.capacity, place.max_bytes)
        for place in places
        for seed in (FIRST_RUN + MOST_SEEDS * number[place.link] + s for s in range(maker.seeds))
    ]


def moved(scenario: Any, seed: int) -> Any:
    """The scenario with the drive of this seed, if its camera moves by drives that are made up."""
    is_made_up = all(motion.name.startswith("drive") for motion in getattr(scenario, "motion", ()))
    return replace(scenario, motion=(_drive(seed),)) if getattr(scenario, "motion", ()) and is_made_up else scenario


_drive = functools.lru_cache(maxsize=4096)(drive_motion)


def digest(runs: Iterable[Run], *more: object) -> str:
    """A name for whatever is computed of these runs: another run, L or V has another one."""
    found = hashlib.sha256(repr(more).encode())
    for run in runs:
        episode, trace = run["episode"], run["episode"].link.trace
        words = (run["link"], run["capacity"], run["max_bytes"], run["value"].name, episode.link.offset_us)
        found.update(repr(words).encode())
        for array in (episode.arrivals, trace.time_us, trace.cumulative_bytes):
            found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()[:16]


def kept(file: Path, find: Callable[[], np.ndarray[Any, Any]]) -> np.ndarray[Any, Any]:
    """The numbers in this file; if it is missing they are found first."""
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        numbers = find()
        with replaced(file) as unfinished, unfinished.open("wb") as stream:
            np.save(stream, numbers)
    return np.asarray(np.load(file, allow_pickle=False))


def bounded(name: str, maker: Maker, folder: Path, say: Callable[[str], None] = print) -> list[Run]:
    """All runs of a family with their bounds, which take up to minutes and are kept in ``folder`` as they are found."""
    runs, found = drawn(maker), list[float]()
    for first in range(0, len(runs), AT_ONCE):
        part = runs[first : first + AT_ONCE]
        file = folder / f"{name}-{digest(part)}.npy"
        if not file.exists() and first:
            say(f"{name}: {first} of {len(runs)} bounds")
        found += kept(file, functools.partial(_bounds, part)).tolist()
    return [{**run, "best": best} for run, best in zip(runs, found, strict=True)]


def _bounds(runs: Iterable[Run]) -> np.ndarray[Any, Any]:
    return np.array([bound_of(run) for run in runs])
