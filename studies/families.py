"""Twelve families of links and streams, on which agents for all links are compared; no agent learns from these runs."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from agents.families import Run, merged, of_suite, run_of
from agents.ready_families import FIRST_SEED, TASK_EPISODES, frames_over, random_stream
from bufgym.scenario.numbered import by_trace
from bufgym.scenario.uplink import uplink_over_lte
from bufgym.utils.errors import unknown
from bufgym.utils.files import replaced

UPLINKS = ("uplink-5g-v1", "uplink-wifi-v1", "uplink-mmwave-v1")
"""Suites over recorded uplinks."""


def task(split: str) -> list[Run]:
    """The training links of the task of ``make train``, at L = 8."""
    scenario = uplink_over_lte()
    parts = by_trace(replace(scenario, traces=scenario.traces[:-2]))
    first = TASK_EPISODES[split]
    return [run_of(trace, part, seed, 8) for trace, part in parts for seed in range(first, first + 8)]


def default_frames(split: str, count: int = 48) -> list[Run]:
    """Generated links of six ways of moving at the default frames of 4.6 MB."""
    seeds = range(FIRST_SEED[split], FIRST_SEED[split] + count)
    parts = [by_trace(frames_over([seed]))[0] for seed in seeds]
    return [run_of(trace, scenario, 0, L) for trace, scenario in parts for L in (5, 8, 16)]


def random_streams(split: str, count: int = 120) -> list[Run]:
    """Rates, sizes, loads, links, L, V and laws of sizes, all at random."""
    cells = map(random_stream, range(FIRST_SEED[split], FIRST_SEED[split] + count))
    return [run_of(cell.label, cell.scenario, 0, cell.capacity) for cell in cells]


def families(split: str, folder: Path, data: str | None = None, leave_out: Sequence[str] = ()) -> dict[str, list[Run]]:
    """All families of the split "validation" or "test" but some; the bounds take minutes and are kept in ``folder``.

    With ``data``, a folder of recordings, there is one more: recorded uplinks.
    """

    def camera(load: str, equal: bool) -> list[Run]:
        return merged(of_suite("jpeg-v1", split, chosen=lambda label: load in label and ("equal" in label) == equal))

    makers: dict[str, Callable[[], list[Run]]] = {
        "task": lambda: task(split),
        "default-frames": lambda: default_frames(split),
        "lte": lambda: merged(of_suite("lte-v2", split, (5, 15))),
        "generated": lambda: merged(of_suite("generated-v2", split, (5, 15), every=2)),
        "outage": lambda: merged(of_suite("outage-v1", split, (5, 15), seeds=4)),
        "sustained": lambda: merged(of_suite("sustained-v1", split, (5, 15), seeds=4)),
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
    for name in leave_out:
        if name not in makers:
            raise unknown("family", name, makers)
        del makers[name]
    for name, make in makers.items():
        kept = folder / f"{split}-{name}.pkl"  # only from your own run: pickles run code when they are read
        if not kept.exists():
            with replaced(kept) as unfinished:
                unfinished.write_bytes(pickle.dumps(make()))
        found[name] = pickle.loads(kept.read_bytes())
    return found
