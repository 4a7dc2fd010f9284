"""Which episode a seed stands for, and which seeds the episodes of a suite have."""

from __future__ import annotations

from typing import Any

from bufgym.errors import BufgymError
from bufgym.scenario import Streams
from bufgym.scenario.suites import Suite

SEEDS_PER_TRACE = 1000
"""Episode s of trace k has the seed 1000 k + s: no two traces of a scenario share a draw."""


def draw(scenario: Any, seed: int) -> Any:
    """The episode of this seed, with the uniform draws of randomised policies."""
    streams = Streams.seeded(seed)
    return scenario.draw(streams).with_uniforms(streams.policy)


def seeds_of(trace: int, seeds: int) -> list[int]:
    """The seeds of so many episodes on the trace of that number."""
    return [SEEDS_PER_TRACE * trace + s for s in range(seeds)]


def seeds_per_trace(suite: Suite, seeds: int | None) -> int:
    """So many, or as many as the suite says."""
    seeds = suite.seeds if seeds is None else seeds
    if not 1 <= seeds <= SEEDS_PER_TRACE:
        raise BufgymError(f"seeds = {seeds}: must lie between 1 and {SEEDS_PER_TRACE}")
    return seeds
