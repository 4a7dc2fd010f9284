"""Every table in which a test can register something, and what puts them back as they were.

``conftest.py`` restores them after each test, so that no test depends on those before it.
"""

import importlib
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from bufgym.policies.registry import Later
from bufgym.utils import modules

REGISTER_AS_THEY_ARE_IMPORTED = (
    "bufgym", "bufgym.policies", "bufgym.oracle", "bufgym.model.observe", "bufgym.scenario", "bufgym.cli",
    "bufgym_papers.perception.worth",
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
    "bufgym:ENVIRONMENTS",
    "gymnasium:registry",
    "bufgym.cli:COMMANDS",
    "bufgym.cli.listing:LISTS",
    "bufgym.traces.formats.links:FORMATS",
    "bufgym.traces.formats.writers:WRITERS",
    "bufgym.traces.formats.bag_files:SOURCES",
    "bufgym.traces.generate.sizes:LAWS",
    "bufgym.utils.modules:FILES",
    "bufgym_robot.entries:LIVE",
    "bufgym_robot.entries:ROS2",
    "bufgym_relay.entries:RELAY",
    "bufgym_robot.buses:BUSES",
    "bufgym_robot.channels:TRANSPORTS",
    "bufgym_relay.plain:PLAIN",
    "bufgym_robot.fleet.ros:SOURCES",
    "bufgym_papers.figures:FIGURES",
    "agents.objectives:OBJECTIVES",
)
"""``module:name`` of a dict or a list, or of a tuple that holds some. A module that nobody imported is left out."""

for _module in REGISTER_AS_THEY_ARE_IMPORTED:
    with suppress(ImportError):  # another package, or its extra
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


def _as_before(table: Any, before: Any) -> Any:
    """What the table shall hold: as before, but a policy that is made at its first use may have been made."""
    if isinstance(table, list):
        return before
    return {name: table.get(name, was) if isinstance(was, Later) else was for name, was in before.items()}


@contextmanager
def forgotten(folder: Path) -> Iterator[None]:
    """Forget modules from the folder, and those that bufgym imported for a user: the next import registers again."""
    path, known, files = sys.path.copy(), set(sys.modules), modules.FILES.copy()
    try:
        yield
    finally:
        sys.path[:] = path
        for name in sys.modules.keys() - known:
            file = getattr(sys.modules[name], "__file__", None)
            users = file in modules.FILES and file not in files and not name.startswith("bufgym")
            if file and (users or Path(file).is_relative_to(folder)):
                del sys.modules[name]


@contextmanager
def restored() -> Iterator[list[str]]:
    """Put all registries back at the end; the list then names what was registered, as "name in module:table"."""
    changed: list[str] = []
    before = _copies()
    try:
        yield changed
    finally:
        for place, table, copy in before:
            wanted = _as_before(table, copy)
            if _same(table, wanted):
                continue
            if isinstance(table, list):
                table[:] = wanted
            else:
                new = [str(name) for name in table if name not in wanted or table[name] is not wanted[name]]
                changed.append(f"{', '.join(new) or 'less than before'} in {place}")
                table.clear()
                table.update(wanted)
