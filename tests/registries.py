"""Every table in which a test can register something, and what puts them back as they were.

``conftest.py`` restores them after each test, so that no test depends on those before it.
"""

import importlib
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

REGISTER_AS_THEY_ARE_IMPORTED = (
    "bufgym", "bufgym.policies", "bufgym.oracle", "bufgym.model.observe", "bufgym.scenario", "bufgym.cli",
)  # fmt: skip
"""Imported before all tests: what is registered does not depend on which test imports them first."""

REGISTRIES = (
    "bufgym.policies.registry:_REGISTRY",
    "bufgym.benchmark.sources:_NAMES",
    "bufgym.model.observe.own:OWN_FIELDS",
    "bufgym.model.observe.own:OWN_TERMS",
    "bufgym.scenario.registry:SCENARIOS",
    "bufgym.scenario.suites:SUITES",
    "bufgym.benchmark.tasks:TASKS",
    "bufgym.benchmark.warmup:PARTS",
    "bufgym:ENVIRONMENTS",
    "gymnasium:registry",
    "bufgym.cli:COMMANDS",
    "bufgym.cli.listing:LISTS",
    "bufgym.traces.formats.links:FORMATS",
    "bufgym.traces.formats.writers:WRITERS",
    "bufgym.traces.formats.bag_files:SOURCES",
    "bufgym.traces.generate.sizes:LAWS",
    "bufgym.ground.modules:FILES",
    "bufgym_live.commands:LIVE",
    "bufgym_live.commands:ROS2",
    "bufgym_live.commands:RELAY",
    "bufgym_live.robot.buses:BUSES",
    "bufgym_live.robot.channels:TRANSPORTS",
    "bufgym_live.relay.plain:PLAIN",
    "bufgym_live.relay.ros:SOURCES",
    "bufgym_papers.figures:FIGURES",
    "agents.objectives:OBJECTIVES",
)
"""``module:name`` of a dict or a list, or of a tuple that holds some. A module that nobody imported is left out."""

for _module in REGISTER_AS_THEY_ARE_IMPORTED:
    importlib.import_module(_module)


def _tables(place: str, found: Any) -> Iterator[tuple[str, Any]]:
    """The dicts and lists in a registry, each with its place: a command's own commands lie in the table of commands."""
    if isinstance(found, dict | list):
        yield place, found
    inside: Iterable[Any] = found.values() if isinstance(found, dict) else found if isinstance(found, tuple) else ()
    for entry in inside:
        if isinstance(entry, dict | list | tuple):
            yield from _tables(place, entry)


def _copies() -> list[tuple[str, Any, Any]]:
    """Place, table and a copy of it, for all that are there now."""
    places = (place.split(":") for place in REGISTRIES)
    known = (
        (f"{module}:{name}", getattr(sys.modules[module], name)) for module, name in places if module in sys.modules
    )
    return [(place, table, table.copy()) for where, found in known for place, table in _tables(where, found)]


def _same(table: Any, before: Any) -> bool:
    """Whether the table holds the same objects in the same order; values need not be comparable."""
    if len(table) != len(before):
        return False
    if isinstance(table, list):
        return all(a is b for a, b in zip(table, before, strict=True))
    return all(a == b and table[a] is before[b] for a, b in zip(table, before, strict=True))


@contextmanager
def forgotten(folder: Path) -> Iterator[None]:
    """Forget all modules that were imported from the folder, and restore where modules are found."""
    path, known = sys.path.copy(), set(sys.modules)
    try:
        yield
    finally:
        sys.path[:] = path
        for name in sys.modules.keys() - known:
            if (file := getattr(sys.modules[name], "__file__", None)) and Path(file).is_relative_to(folder):
                del sys.modules[name]


@contextmanager
def restored() -> Iterator[list[str]]:
    """Put all registries back at the end; the list then names what was changed, as "entry in module:name"."""
    changed: list[str] = []
    before = _copies()
    try:
        yield changed
    finally:
        for place, table, copy in before:
            if _same(table, copy):
                continue
            new = [
                entry
                for entry in table
                if entry not in copy or (isinstance(table, dict) and table[entry] is not copy[entry])
            ]
            changed.append(f"{', '.join(map(str, new)) or 'less than before'} in {place}")
            if isinstance(table, list):
                table[:] = copy
            else:
                table.clear()
                table.update(copy)
