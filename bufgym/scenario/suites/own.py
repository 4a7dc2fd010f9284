"""Suites of one's own: a scenario, or several by label, frozen by seeds."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bufgym import scenario as registry
from bufgym.model.checks import check_name, whole
from bufgym.scenario.numbered import by_trace, draw
from bufgym.scenario.suites.suite import Setting, Suite
from bufgym.utils.errors import BufgymError

MOST_SEEDS = 300
"""Most episodes on each trace; the splits have seeds of their own."""
FIRST_SEEDS = {"train": 0, "validation": MOST_SEEDS, "test": 2 * MOST_SEEDS}
_SEED_OF_CELLS = 3  # The seed of the episodes that tell two suites of one name apart


@dataclass(frozen=True, eq=False)
class Scenarios:
    """The scenarios of one's own suite, the same in each split, which differ in their seeds."""

    settings: Mapping[str, Setting]

    def __call__(self, split: str, data: Path) -> dict[str, Setting]:
        return dict(self.settings)


def own_suite(
    name: str, scenarios: Any, *, capacity: Any = (8,), seeds: int = 10, about: str = "", kind: str = "queue"
) -> Suite:
    """A suite of these scenarios, see ``bufgym.suite``; ``kind`` is that of their task."""
    check_name("suite", name)
    many = scenarios if isinstance(scenarios, Mapping) else {name: scenarios}
    if not many:
        raise BufgymError(f"suite {name}: needs at least one scenario")
    settings = {}
    for label, spec in many.items():
        check_name(f"suite {name}: scenario", label)
        scenario = registry.get(spec)
        settings[label] = Setting(scenario, registry.about(scenario).partition("\n")[0].removesuffix("."))
    capacities = tuple(capacity) if isinstance(capacity, tuple | list) else (capacity,)
    for L in capacities:
        whole("capacity", L, 1)
    if not capacities or len(set(capacities)) < len(capacities):
        raise BufgymError(f"capacity = {capacity!r}: must be whole numbers >= 1, no two alike")
    whole("seeds", seeds, 1, MOST_SEEDS)
    about = about or f"a suite of one's own: {', '.join(setting.about for setting in settings.values())}"
    build = Scenarios(settings)
    return Suite(name, about.removesuffix("."), build, capacities, seeds, kind=kind, first_seeds=FIRST_SEEDS)


def fingerprint(scenario: Any) -> str:
    """A hash of an episode of each of its traces: two scenarios with equal ones draw the same."""
    digest = hashlib.sha256()
    for label, part in by_trace(scenario):
        digest.update(label.encode())
        _add(digest, draw(part, _SEED_OF_CELLS))
    return digest.hexdigest()[:16]


def _add(digest: Any, value: Any) -> None:
    """Add the numbers and the texts in a value to the hash, with the names of its parts."""
    if isinstance(value, np.ndarray):
        digest.update(f"{value.dtype}{value.shape}".encode() + value.tobytes())
    elif isinstance(value, Mapping):
        for key in value:
            digest.update(f"{key}:".encode())
            _add(digest, value[key])
    elif isinstance(value, list | tuple):
        for part in value:
            _add(digest, part)
    elif is_dataclass(value):
        _add(digest, {field.name: getattr(value, field.name) for field in fields(value)})
    elif value is None or isinstance(value, str | bool | int | float | np.generic):
        digest.update(repr(value).encode())
