"""Parts that ``bufgym warmup`` compiles by running each once on a tiny input."""

import time
from collections.abc import Callable, Iterable
from typing import Any

import gymnasium
import numpy as np

from bufgym import jit, policies, scenario
from bufgym.benchmark.run import run
from bufgym.envs import FleetVecEnv, SenderVectorEnv
from bufgym.scenario import FleetScenario, Interruption

_L = 2


def _played(batch: Any, rows: int) -> None:
    batch.reset(seed=0)
    batch.step(np.full(rows, _L))


def _environments() -> None:
    short: dict[str, Any] = {"duration_s": 1.0}
    for name, parameters in {"interruption": {"t_max": 5}, "lte": short, "topics": short}.items():
        _played(SenderVectorEnv(2, name, _L, **parameters), 2)
    env = gymnasium.make("bufgym/Interruption-v0", capacity=_L)
    env.reset(seed=0)
    env.step(_L)


def _run(names: Iterable[str], *scenarios: Any) -> None:
    for on in scenarios:
        run([policies.get(name) for name in names], on, [_L], 1)


def _fleets() -> None:
    _played(FleetVecEnv(1, 2, "lte", _L, duration_s=1.0), 2)
    _run(["drop-oldest"], FleetScenario.of(2, "lte", duration_s=1.0))


PARTS: dict[str, Callable[[], object]] = {
    "policies of one queue": lambda: _run(policies.names(for_topics=False), Interruption(t_max=5)),
    "environments": _environments,
    "policies of several topics": lambda: _run(policies.names(for_topics=True), scenario.get("topics", duration_s=1.0)),
    "the clairvoyant": lambda: _run(
        ["drop-oldest"], *(scenario.get("lte", duration_s=1.0, size_cv=cv) for cv in (0.0, 0.5))
    ),
    "fleets": _fleets,
}
"""Description of a part -> function that compiles it."""


def compile_part(what: str) -> float:
    """Compile one of ``PARTS``; return the time taken in s."""
    jit.compile_silently()
    began_s = time.perf_counter()
    PARTS[what]()
    return time.perf_counter() - began_s
