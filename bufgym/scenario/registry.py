"""The one registry of scenarios, by name."""

import ast
import functools
import os
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar, cast

import numpy as np

from bufgym.model.qoi import Value
from bufgym.scenario.afr_evaluation import afr_evaluation
from bufgym.scenario.client import client_over_lte, read_client
from bufgym.scenario.episode import Scenario
from bufgym.scenario.interruption import Interruption
from bufgym.scenario.texts import how_rated
from bufgym.scenario.uplink import uplink_over_lte
from bufgym.utils import modules
from bufgym.utils.errors import BufgymError, unknown
from bufgym.utils.settings import named_settings


def _suite() -> Scenario:
    from bufgym.scenario.suites.mixture import SuiteScenario  # suites are made of scenarios

    return SuiteScenario()


SCENARIOS: dict[str, tuple[Callable[[], Scenario], str]] = {
    "interruption": (Interruption, "one interruption of unknown length (AFR paper, Sec. III-B)"),
    "lte": (uplink_over_lte, "30 Hz RGB-D camera on a driving robot over the shipped synthetic LTE traces"),
    "topics": (client_over_lte, "the topics of Robofleet's example client over the shipped synthetic LTE traces"),
    "afr-evaluation": (afr_evaluation, "AFR's evaluation: 794 frames at 30 Hz over car_0002 or a stand-in"),
    "suite": (_suite, "the scenarios of a suite's split, one of them drawn for each episode"),
}
"""Name -> (function or class that makes it, one line about it)."""


Maker = TypeVar("Maker", bound=Callable[[], Any])
_BUILT_IN = frozenset(SCENARIOS)


def register(name: str, about: str = "") -> Callable[[Maker], Maker]:
    """Register the decorated class or function as the scenario ``name``; it comes back unchanged.

    A function takes no arguments and returns a ``Scenario``. ``about`` is a line, by default the docstring's first.

    Raises:
        BufgymError: the name is a built-in scenario's, empty, or holds a blank, ":" or "=".
    """
    if not isinstance(name, str) or not name or any(c in ":= \t\n" for c in name) or name.endswith(".toml"):
        raise BufgymError(f"scenario {name!r}: a name must be non-empty, without spaces, ':', '=' and '.toml'")
    if name in _BUILT_IN:
        raise BufgymError(f"scenario {name!r}: a built-in scenario has this name")

    def add(make: Maker) -> Maker:
        if not callable(make):
            raise BufgymError(f"scenario {name!r}: {make!r} is neither a class nor a function")
        SCENARIOS[name] = make, about or modules.first_line(make)
        return make

    return add


@functools.cache
def _made(name: str, make: Callable[[], Any]) -> Scenario:
    return checked(make(), name)


def checked(scenario: Any, name: str) -> Scenario:
    """Check that this has all that a scenario needs, and return it."""
    count = getattr(scenario, "max_messages", None)
    for what, holds in (
        ("`value`, a bufgym.model.qoi Value", isinstance(getattr(scenario, "value", None), Value)),
        ("method `draw(streams)` that returns an Episode", callable(getattr(scenario, "draw", None))),
        ("`max_messages`, a whole number >= 1", isinstance(count, int | np.integer) and count >= 1),
        ("`topics`, a tuple; () for one queue", isinstance(getattr(scenario, "topics", None), tuple)),
    ):
        if not holds:
            raise BufgymError(f"scenario {name}: {scenario!r} has no {what}")
    return cast(Scenario, scenario)


def _literal(text: str) -> Any:
    """A literal of Python, or the text itself."""
    try:
        return ast.literal_eval(text)
    except (SyntaxError, ValueError):
        return text


def get(spec: str | os.PathLike[str] | Scenario, /, **overrides: Any) -> Scenario:
    """The scenario of that name, or ``spec`` itself, with changed parameters; BufgymError for unknown ones.

    A name that ends in .toml, or a path, names a client's configuration (``read_client``). ``module:function`` is
    imported (see ``bufgym.utils.modules``); it is a scenario or makes one without arguments. A name may carry
    parameters, as in ``"lte:rate_hz=5,motion=none"``.
    """
    if isinstance(spec, os.PathLike):
        spec = os.fspath(spec)
    if isinstance(spec, str) and "=" in spec.partition(":")[2]:
        spec, settings = named_settings("scenario", spec, _literal)
        overrides = settings | overrides
    if isinstance(spec, str) and spec.endswith(".toml"):
        spec = read_client(spec)
    elif isinstance(spec, str) and modules.is_named(spec):
        found = modules.find(spec)
        spec = checked(found() if callable(found) else found, spec)
    elif isinstance(spec, str):
        if spec not in SCENARIOS:
            raise unknown("scenario", spec, SCENARIOS, ", and module:function for one's own")
        spec = _made(spec, SCENARIOS[spec][0])
    else:
        spec = checked(spec, type(spec).__name__)
    if not overrides:
        return spec
    return with_parameters(spec, overrides)


def about(scenario: Any) -> str:
    """Lines about a scenario: its own ``about``, or how it is rated where it has none."""
    return str(getattr(scenario, "about", "") or how_rated(scenario))


def parameters(spec: Any) -> list[str]:
    """Names of a scenario's parameters, sorted; none where it is no dataclass."""
    return sorted(f.name for f in fields(spec)) if is_dataclass(spec) else []


def with_parameters(spec: Scenario, changes: Mapping[str, Any], place: str = "") -> Scenario:
    """The scenario with changed parameters, if it has all of them; see ``get``. Errors name ``place`` or its class."""
    known = parameters(spec)
    for name in changes:
        if name not in known:
            also = "" if known else " (it is no dataclass)"
            raise unknown("parameter", name, known, also, place or type(spec).__name__)
    return replace(spec, **changes)  # type: ignore[type-var]
