"""Observation fields and reward terms of one's own, by name: ``@field`` and ``@reward_term``.

docs/guide/yours-to-change.md has an example of each.

Fields and terms take part only where they are named. Text that has to stand alone names ``module:function``, which
imports the module that registers them. ``compile=True`` promises that the function is a kernel.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass, replace
from dataclasses import field as entry
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from bufgym.model.checks import changed, check_name, constants, is_number
from bufgym.model.observe.candidates import CANDIDATE_FIELDS, QUEUE_FIELDS
from bufgym.model.observe.chosen import BUILT_IN
from bufgym.model.observe.declare import Field, Function
from bufgym.model.observe.topics import TOPIC_FIELDS
from bufgym.utils import modules
from bufgym.utils.errors import BufgymError
from bufgym.utils.settings import named_settings


@dataclass(frozen=True)
class RewardTerm:
    """A named reward; an environment rewards a weighted sum of them and reports each by name in ``info``."""

    name: str
    """Unique over all terms."""
    unit: str
    """Its unit."""
    meaning: str
    """Meaning in words."""


@dataclass(frozen=True)
class OwnTerm(RewardTerm):
    """A reward that a function computes."""

    _: KW_ONLY
    function: Function
    """(step, memory) -> number; ``step`` is a ``bufgym.envs.own.Step``."""
    parameters: Mapping[str, float] = entry(default_factory=dict)
    """Names and values of its settings, which the function reads as ``step.parameters``."""
    memory: Mapping[str, float] = entry(default_factory=dict)
    """Names and initial values of its memory, float64[entries], at an episode's begin."""
    one_queue: bool = False
    """Whether it is for one queue only; with several topics it is missing, or one of ``TOPIC_REWARD_TERMS``."""
    compile: bool = False
    """As in ``Field``."""
    at_end: bool = False
    """Whether the function runs only in the step that ends the episode; the term is 0 in all others."""
    prepare: Callable[[], object] | None = None
    """Called once for each environment that names the term, as it is made: work that no step should wait for."""
    built_in: bool = False
    """Whether it is bufgym's own, whose name stays taken."""

    @property
    def parameter_array(self) -> NDArray[np.float64]:
        """Numbers for ``step.parameters``: float64[parameters], read-only."""
        return constants(self.parameters.values())


REWARD_TERMS = (
    RewardTerm("delivered", "QoI", "V gained when a message arrives at the server; sums to H - 1"),
    RewardTerm("retained", "QoI", "change of the H that delivering all that is kept would give; sums to H - 1 too"),
)
"""``retained`` is ``delivered`` shaped by a potential, the QoI held and not yet delivered (Ng, Harada and Russell
1999). It shows at once what a decision costs or gains, and telescopes to the same total."""
OWN_FIELDS: dict[str, Field] = {}
"""Your own fields by name, in the order of their registration."""
OWN_TERMS: dict[str, OwnTerm] = {}
"""Terms likewise; the built-in ones are in ``bufgym.model.observe.terms``."""

Entry = TypeVar("Entry", Field, OwnTerm)


def field(
    name: str, *, per: str, unit: str = "", low: float = 0.0, high: float = 1.0, compile: bool = False
) -> Callable[[Function], Function]:
    """Register the decorated function as the observation field ``name``; it comes back unchanged.

    Args:
        name: unlike all others; environments with ``fields=[..., name]`` observe it.
        per: "slot": ``f(buffer, arrival, k)`` is asked for each queued message k, and for the newcomer, which is k =
            ``len(buffer.slots)``; or "context": ``f(buffer, arrival)``. ``buffer`` is a ``bufgym.model.buffer.Buffer``,
            ``arrival`` a MESSAGE. Where a free socket asks (several topics), ``arrival`` is the last one that came.
        unit: for lists, as the first line of the function's docstring; how it is scaled.
        low: least value; an empty slot and an ended episode read 0, so low <= 0 <= high.
        high: largest value. A number outside is an error.
        compile: promises that the function is a kernel.

    Raises:
        BufgymError: the name is taken or no name, or a rule above is broken.
    """
    others = (known.name for known in CANDIDATE_FIELDS + QUEUE_FIELDS + TOPIC_FIELDS)
    _check_name("field", name, (*BUILT_IN, *others), OWN_FIELDS)
    if per not in ("slot", "context"):
        raise BufgymError(f"field {name!r}: per = {per!r}: must be 'slot' or 'context'")
    if not (is_number(low) and is_number(high) and -math.inf < low <= 0 <= high < math.inf and low < high):
        raise BufgymError(
            f"field {name!r}: low = {low!r}, high = {high!r}: need low <= 0 <= high, as empty slots are 0"
        )

    def add(function: Function) -> Function:
        _check_function("field", name, function, 3 if per == "slot" else 2)
        meaning = modules.first_line(function)
        OWN_FIELDS[name] = Field(name, per, "own", unit, meaning, function, low, high, compile)
        return function

    return add


def reward_term(name: str, *, unit: str = "", **fields: Any) -> Callable[[Function], Function]:
    """Register the decorated function ``f(step, memory)`` as the reward term ``name``; it comes back unchanged.

    Environments whose ``reward`` names it compute it at each step. ``reward={"retained": 1, "late:deadline_s=2": 0.1}``
    sets a parameter. A weight of 0 reports the term without counting it. ``step`` is a ``bufgym.envs.own.Step``, and
    ``memory`` is float64[entries] for each sender and episode. Keywords are the fields of ``OwnTerm``: ``parameters``,
    ``memory``, ``one_queue``, ``compile``, ``at_end``, ``prepare``.

    Raises:
        BufgymError: the name is taken or no name, not two arguments, or ``at_end`` with ``compile``.
    """
    _check_name("reward term", name, (known.name for known in REWARD_TERMS), OWN_TERMS)
    if fields.get("at_end") and fields.get("compile"):
        raise BufgymError(f"reward term {name!r}: at_end = True: is for plain Python, so compile must be False")

    def add(function: Function) -> Function:
        _check_function("reward term", name, function, 2)
        OWN_TERMS[name] = OwnTerm(name, unit, modules.first_line(function), function=function, **fields)
        return function

    return add


def own_field(text: str) -> Field | None:
    """The field of one's own of that name, or the one that ``module:function`` registers; None if there is none."""
    return _found(text, OWN_FIELDS, "field")


def own_term(text: str) -> OwnTerm | None:
    """The term that ``text`` names, also by ``name:parameter=number`` or ``module:function``; None if there is none."""
    if modules.is_named(text):
        return _found(text, OWN_TERMS, "reward term")
    name, settings = named_settings("reward term", text)
    term = OWN_TERMS.get(name)
    if term is None or not settings:
        return term
    return replace(term, name=text, parameters=changed(f"reward term {name}", term.parameters, settings))


def _found(text: str, entries: Mapping[str, Entry], what: str) -> Entry | None:
    if not modules.is_named(text):
        return entries.get(text)
    function = modules.find(text)
    found = next((known for known in entries.values() if known.function is function), None)
    if found is None:
        raise BufgymError(f"{text}: is not registered as a {what}")
    return found


def _check_name(what: str, name: str, built_in: Any, entries: Mapping[str, Any]) -> None:
    check_name(what, name)
    taken = entries.get(name)
    if name in built_in or getattr(taken, "built_in", False):
        raise BufgymError(f"{what} {name!r}: a built-in {what} has this name")


def _check_function(what: str, name: str, function: Any, arguments: int) -> None:
    if not callable(function) or modules.needs(function) != arguments:
        shape = {2: "(buffer, arrival)", 3: "(buffer, arrival, k)"}[arguments] if what == "field" else "(step, memory)"
        raise BufgymError(f"{what} {name!r}: {function!r} must be a function {shape}")
