"""The one registry of scenarios, by name."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

from bufgym.errors import BufgymError
from bufgym.scenario.configuration import client_over_lte, read_client
from bufgym.scenario.episode import Scenario
from bufgym.scenario.interruption import Interruption
from bufgym.scenario.uplink import uplink_over_lte


def _suite() -> Scenario:
    from bufgym.scenario.suites.mixture import SuiteScenario  # suites are made of scenarios

    return SuiteScenario()


SCENARIOS: dict[str, tuple[Callable[[], Scenario], str]] = {
    "interruption": (Interruption, "one interruption of unknown length (AFR paper, Sec. III-B)"),
    "lte": (uplink_over_lte, "30 Hz RGB-D camera on a driving robot over the shipped synthetic LTE traces"),
    "topics": (client_over_lte, "the topics of Robofleet's example client over the shipped synthetic LTE traces"),
    "suite": (_suite, "the scenarios of a suite's split, one of them drawn for each episode"),
}
"""Name -> (what makes it, one line about it)."""


@functools.cache
def _named(name: str) -> Scenario:
    return SCENARIOS[name][0]()


def get(spec: str | Scenario, **overrides: Any) -> Scenario:
    """The scenario of that name (or ``spec`` itself), with these parameters changed; BufgymError for unknown ones.

    A name that ends in .toml is that of a client's configuration (``read_client``).
    """
    if isinstance(spec, str) and spec.endswith(".toml"):
        spec = read_client(spec)
    elif isinstance(spec, str):
        if spec not in SCENARIOS:
            raise BufgymError(f"unknown scenario {spec!r}; known: {', '.join(SCENARIOS)}")
        spec = _named(spec)
    if not overrides:
        return spec
    known = {f.name for f in fields(spec)}  # type: ignore[arg-type]
    for name in overrides:
        if name not in known:
            raise BufgymError(f"{type(spec).__name__}: no parameter {name!r}; it has: {', '.join(sorted(known))}")
    return replace(spec, **overrides)  # type: ignore[type-var]
