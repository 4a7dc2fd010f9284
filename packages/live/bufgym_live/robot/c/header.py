"""Builder of a policy's header from parts in C and the policy's numbers as constants."""

import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from bufgym import policies
from bufgym.model.buffer import UNLIMITED_BYTES, check_limits
from bufgym.model.link import FOREVER
from bufgym.model.observe import candidates
from bufgym.model.observe.declare import TINY
from bufgym.model.observe.queue import ROUNDING
from bufgym.model.qoi import EXPONENTIAL, SATURATING, TABULATED, Value
from bufgym.policies import (
    Policy,
    candidate_network,
    chains,
    gaps,
    guided,
    learned,
    price_dp,
    ruled_network,
    target_gap,
    thinning,
)
from bufgym.policies.learned import Weights
from bufgym.policies.scoring import Scorer, unpack
from bufgym.policies.target_gap import straight
from bufgym.traces.formats.text import write_text
from bufgym.utils import __version__
from bufgym.utils.errors import BufgymError, printable
from bufgym_live.robot.c.calls import random_episode, recorded

_PARTS, _RULES = (Path(__file__).parent / folder for folder in ("parts", "rules"))
SUPPORTED = tuple(sorted(path.stem for path in _RULES.glob("*.h")))
"""Names of the exportable rules; learned agents for one queue are exportable too."""
_HELPERS = {
    "bufgym_gaps_of(": "gaps.h",
    "bufgym_smallest_gap(": "gaps.h",
    "bufgym_spare(": "thinning.h",
    "bufgym_remember(": "target_gap.h",
    "bufgym_weigh(": "chains.h",
    "bufgym_priced(": "price_dp.h",
    "bufgym_look(": "inputs.h",
    "bufgym_thin(": "thin.h",
}
"""Parts that rules share, each before its callers."""
_CONSTANTS = {
    thinning: "WAITING SOON_US STEADY",
    target_gap: "LEAST SHORT_QUEUE SHORT_RUN_US SLOWEST BURSTY LATE TOLD WITHIN",
    price_dp: "LEAST_SHARE SIZES_WEIGHT UNPRICED",
    chains: "SPAN",
    gaps: "TIE",
    guided: "MOST SPREAD_US SLOW_US HEAVY HEAVIER",
    ruled_network: "EVEN_US EVEN",
}
"""Constants that the parts name, by the module that has them."""
_RULE = "rule_"
"""Prefix under which a network reads the inputs of the rule gap-price."""
_VALUES = {EXPONENTIAL: "exponential", SATURATING: "saturating", TABULATED: "tabulated"}
_SEED, _EPISODES, _MESSAGES = 20_220_523, 6, 40  # Seed, episodes and messages of the calls in the header


def write(
    policy: Policy, out: str | Path, capacity: int, value: Value, max_bytes: int | None = None, prefix: str = "bufgym"
) -> Path:
    """Write ``header`` to the file ``out``, whole or not at all.

    Raises:
        BufgymError: as ``header``, or the file cannot be written.
    """
    write_text(out, [header(policy, capacity, value, max_bytes, prefix)])
    return Path(out)


def header(
    policy: Policy,
    capacity: int,
    value: Value,
    max_bytes: int | None = None,
    prefix: str = "bufgym",
    parity: bool = True,
) -> str:
    """Make the policy's C99 header for L up to ``capacity`` and B = ``max_bytes`` with V = ``value``.

    All its names begin with ``prefix``, its macros with the same in capitals. With ``parity`` it has recorded calls,
    which take time to make: the simulator plays them.

    Raises:
        BufgymError: the policy or a field that it reads has no C, a limit is invalid, or C has no names that begin so.
    """
    check_limits(capacity, max_bytes)
    if re.fullmatch("[a-z][a-z0-9_]*", prefix) is None:
        raise BufgymError(f"prefix {prefix!r}: must be small letters, digits and _, as names in C begin")
    learns = policy.on_arrival is learned.on_arrival
    guides = policy.on_arrival is guided.on_arrival
    ruled = policy.on_arrival is ruled_network.on_arrival
    chooses = ruled or policy.on_arrival is candidate_network.on_arrival
    body = _among_candidates(ruled) if chooses else _network(policy) if learns else _rule(policy, guides)
    parameters = policy.parameters
    if ruled:
        parameters = price_dp.PARAMETERS
    elif guides:
        parameters = dict(zip(price_dp.PARAMETERS, policy.weights, strict=False))
    if "bufgym_departure(" not in body:
        body += "\n" + _part("no_departure.h")
    unlimited = max_bytes is None
    numbers = {
        "ABOUT": _comment(policy.summary),
        "SOURCE": _comment(policy.source),
        "NAME": _comment(policy.name),
        "VERSION": __version__,
        "CAPACITY": capacity,
        "FOREVER": FOREVER,
        "UNLIMITED": UNLIMITED_BYTES,
        "MAX_BYTES": "BUFGYM_UNLIMITED" if unlimited else f"INT64_C({max_bytes})",
        "LIMIT": "no limit" if unlimited else max_bytes,
        "MEMORY": ", ".join(map(repr, map(float, policy.memory.values()))) or "0.0",
        "MEMORY_SIZE": max(1, len(policy.memory)),
        "PARAMETERS": _array("double", "bufgym_parameters", policy.parameters.values()) if policy.parameters else "",
        "VALUE": _comment(value.name),
        "VALUE_PART": _array("double", "bufgym_v", value.array) + _part(f"value_{_VALUES[int(value.array[0])]}.h"),
        "SCRATCH": _part("places.h") if "bufgym_weigh(" in body else "",
        "POLICY": body,
        "TINY": repr(TINY),
        "ROUNDING": repr(ROUNDING),
        **{name: repr(getattr(module, name)) for module, names in _CONSTANTS.items() for name in names.split()},
        "STRAIGHT": repr(_uncompiled(straight)(value.array)),
        **{name.upper(): repr(float(number)) for name, number in parameters.items()},
        "INPUTS": _lines(f"BUFGYM_IN_{name.upper()}" for name in guided.INPUTS),
        "OUTPUTS": _lines(f"BUFGYM_OUT_{output.name.upper()}" for output in guided.OUTPUTS),
        "WEIGHTS": _array("double", "bufgym_weights", policy.weights[guided.NUMBERS :]) if guides else "",
        "STEADY_US": repr(thinning.HORIZON_US),
    }
    if learns:
        numbers |= _numbers(policy, _scorer(policy))
    if chooses:
        numbers |= _candidate_numbers(policy)
    last = ""
    if parity:
        rng, last = np.random.default_rng(_SEED), _part("parity.h")
        # Messages of the calls in the header all fit into B.
        episodes = [random_episode(rng, _MESSAGES, max_bytes) for _ in range(_EPISODES)]
        calls = recorded(policy, episodes, capacity, value, max_bytes)
        numbers["CALLS"] = "".join(f"    {{{', '.join(map(repr, call.item()))}}},\n" for call in calls)
    text = _filled(_part("about.h") + _part("queue.h") + last + "\n#endif\n", numbers)
    named = re.sub(r"\bbufgym_", f"{prefix}_", text)
    return re.sub(r"\bBUFGYM_", f"{prefix.upper()}_", named)


def _rule(policy: Policy, guides: bool) -> str:
    """Write the C of a rule, or of an agent that guides one, after the parts that it shares."""
    name = policy.name.partition(":")[0]
    if not guides and (name not in SUPPORTED or policies.get(name).on_arrival is not policy.on_arrival):
        known = ", ".join(SUPPORTED)
        raise BufgymError(f"policy {policy.name}: has no C; known: {known}, and learned agents for one queue")
    if guides:
        _refuse_without_c(policy, [f"{_RULE}{name}" for name in guided.INPUTS])
    return _helped(_part("guided.h") if guides else (_RULES / f"{name}.h").read_text(encoding="utf-8"))


def without_c(fields: Iterable[str]) -> dict[str, str]:
    """Field -> part that lacks it, for those of the ``fields`` of one queue that no part writes."""
    lacking = {}
    for name in fields:
        part, macro = "features.h", name.upper()
        if name.startswith(_RULE):
            part, macro = "inputs.h", f"IN_{name.removeprefix(_RULE).upper()}"
        if re.search(rf"\[BUFGYM_{macro}\](\[\w+\])? =\s", _part(part)) is None:
            lacking[name] = part
    return lacking


def _refuse_without_c(policy: Policy, fields: Iterable[str]) -> None:
    lacking = [f"{name} in {part}" for name, part in without_c(fields).items()]
    if lacking:
        where = "write them in bufgym_live/robot/c/parts/ beside the others"
        raise BufgymError(f"policy {policy.name}: reads fields that have no C: {', '.join(lacking)}: {where}")


def _network(policy: Policy) -> str:
    """Write the C of a learned agent for one queue, after the parts that observe what it reads."""
    scorer = _scorer(policy)
    context, slots = scorer.fields[: scorer.context], scorer.fields[scorer.context :]
    names = [Weights.CONTEXT_NAMES[int(k)] for k in context] + [Weights.SLOT_NAMES[int(k)] for k in slots]
    _refuse_without_c(policy, names)
    return _helped(_part("fields.h") + _part("features.h") + _part("scorer.h"))


def _among_candidates(ruled: bool) -> str:
    """Write the C of a network among candidates, and what the rule does where that is an action, ``ruled``."""
    return _part("candidates.h") + "\n" + (_helped(_part("ruled.h")) if ruled else _part("choice.h"))


def _helped(rule: str) -> str:
    """Put the parts that it shares before ``rule``."""
    helpers = ""
    for call, part in reversed(_HELPERS.items()):  # a helper may call the one before it
        if call in helpers + rule and _part(part) not in helpers:
            helpers = _part(part) + helpers
    return helpers + rule


def _scorer(policy: Policy) -> Scorer:
    found: Scorer = _uncompiled(unpack)(np.array(policy.weights))
    return found


def _uncompiled(kernel: Any) -> Any:
    """Get a kernel's function in Python: one call is not worth the compiler."""
    return getattr(kernel, "py_func", kernel)


def _numbers(policy: Policy, scorer: Scorer) -> dict[str, Any]:
    """Collect the values for a learned policy's C: its scorer, the scratch and the fields."""
    inputs, units = len(scorer.fields), max(1, 2 * scorer.first + scorer.second)
    text = _array("int", "bufgym_fields", scorer.fields.astype(int))
    text += _array("double", "bufgym_networks", scorer.networks)
    sizes = ", ".join(map(str, (inputs, scorer.context, scorer.first, scorer.second, scorer.size)))
    text += f"static const struct bufgym_scorer bufgym_scorer = {{{sizes}, bufgym_fields, bufgym_networks}};\n"
    slots, context = Weights.SLOT_NAMES, Weights.CONTEXT_NAMES
    scratch = (
        "    /* scratch of the policy: features, direct weights, hidden units, all fields */\n"
        f"    double f[{inputs}], skip[{inputs}], h[{units}], context[{len(context)}];\n"
        f"    double rows[{len(slots)}][BUFGYM_CAPACITY + 1];\n"
    )
    return {"WEIGHTS": text, "SCRATCH": scratch, "SLOT_FIELDS": _enum(slots), "CONTEXT_FIELDS": _enum(context)}


def _candidate_numbers(policy: Policy) -> dict[str, Any]:
    """Collect the values for the C of a network among candidates: its layers, the scratch and constants."""
    hidden = int(policy.weights[candidate_network.HIDDEN])
    begin = candidate_network.WIDTHS + hidden + 1
    k, masks, tanh = (int(policy.weights[i]) for i in range(candidate_network.HIDDEN))
    widths = [int(width) for width in policy.weights[candidate_network.WIDTHS : begin]]
    ruled = policy.on_arrival is ruled_network.on_arrival
    seen = int(ruled_network.seen(k)) if ruled else candidate_network.inputs(k)
    units = seen + sum(widths)
    layers = _array("int", "bufgym_widths", widths) + _array("double", "bufgym_layers", policy.weights[begin:])
    scratch = "    /* scratch of the policy: its candidates, and units of all layers */\n"
    scratch += f"    int order[{k + 1}];\n    double cost[{k + 1}], units[{units}];\n"
    scratch += _part("places.h") if ruled else ""
    return {
        "WEIGHTS": layers, "SCRATCH": scratch, "CANDIDATES": k, "SEEN": seen, "HIDDEN": hidden, "ACTIONS": widths[-1],
        "MASKS": masks, "TANH": tanh, "NONE": candidates.NONE, "TIE": repr(candidates.TIE),
        "LEAST_RATIO": repr(candidates.LEAST), "LARGEST_RATIO": repr(candidates.LARGEST), "E": repr(math.e),
        "E_SQUARED": repr(math.e**2), "SQRT_HALF": candidates.SQRT_HALF, "LOG_TWO": repr(float(candidates.LOG_2)),
        "C_THREE": repr(float(candidates.C3)), "C_FIVE": repr(float(candidates.C5)),
        "C_SEVEN": repr(float(candidates.C7)),
    }  # fmt: skip


def _part(name: str) -> str:
    return (_PARTS / name).read_text(encoding="utf-8")


def _filled(text: str, numbers: dict[str, Any]) -> str:
    """Replace each @NAME@, also inside inserted text."""
    while re.search("@[A-Z_]+@", text):
        text = re.sub("@([A-Z_]+)@", lambda found: str(numbers[found[1]]), text)
    return text


def _comment(text: str) -> str:
    """Escape text for a comment or an inserted line."""
    return printable(text).replace("*/", "* /").replace("@", "(at)")


def _array(kind: str, name: str, numbers: Iterable[Any]) -> str:
    """Write ``static const kind name[] = {...};`` with numbers exact to the last bit."""
    words = _lines(repr(float(number) if kind == "double" else int(number)) for number in numbers)
    return f"static const {kind} {name}[] = {{\n    {words}\n}};\n"


def _lines(words: Iterable[str]) -> str:
    """Join the words with commas, five in a line."""
    found = list(words)
    return ",\n    ".join(", ".join(found[k : k + 5]) for k in range(0, len(found), 5))


def _enum(names: Iterable[str]) -> str:
    return f"enum {{\n    {_lines(f'BUFGYM_{name.upper()}' for name in names)}\n}};"
