"""A policy's C99 header: the queue in C, and the policy's own functions, translated from their Python."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from bufgym import policies
from bufgym.kernels.kinds import FLOAT, INT, Pointer, Record, array_kind, record_kind
from bufgym.kernels.program import Program
from bufgym.model import qoi
from bufgym.model.buffer import MESSAGE, TOPIC, UNLIMITED_BYTES, Buffer, check_limits
from bufgym.model.link import FOREVER
from bufgym.model.past import PAST, begin_past, remember_past
from bufgym.model.qoi import Value
from bufgym.policies import Policy
from bufgym.policies.registry import signatures, view_kind
from bufgym.sim import Senders
from bufgym.traces.formats.text import write_text
from bufgym.utils import __version__
from bufgym.utils.errors import BufgymError, printable
from bufgym_robot.c.calls import random_episode, recorded

_PARTS = Path(__file__).parent / "parts"
_HOOKS = ("on_arrival", "on_departure", "on_dequeue", "on_send")
_SEEN = {
    "capacity": "q->capacity", "max_bytes": "BUFGYM_MAX_BYTES", "busy": "q->busy > 0", "left_bytes": "left_bytes",
    "left_fraction": "left_bytes > 0 ? (double)left_bytes / (double)q->held_bytes : 0.0",
    "stalled_us": "q->now_us - q->last_dequeue_us", "in_flight": "q->busy",
    "short_rate_bytes_per_s": "1e6 * q->short_rate", "medium_rate_bytes_per_s": "1e6 * q->medium_rate",
    "long_rate_bytes_per_s": "1e6 * q->long_rate", "remaining_us": "bufgym_remaining_us(q)",
}  # fmt: skip
"""Field of a ``Buffer`` -> what it is in C, where the queue has no member of that name."""
_REMEMBER = """        bufgym_remember_past({}, q->now_us, gap_us, arrival->x, arrival->x - q->previous_x,
                             q->sent_bytes, q->sending_us, 1e6 * q->medium_rate);
"""
_SEED, _EPISODES, _MESSAGES = 20_220_523, 6, 40  # Seed, episodes and messages of the calls in the header


def why_not(policy: Policy) -> str:
    """Why a policy has no queue in C; empty if it has."""
    if not policy.compile:
        return "it is plain Python: only a kernel becomes C, which compile=True promises"
    if policy.for_topics or policy.schedules:
        return "it is made for several topics, and the queue in C has one"
    return policy.unranked_because


def supported() -> tuple[str, ...]:
    """Names of bufgym's own policies that have a queue in C."""
    names = (*policies.names(), *policies.names(named_only=True))
    return tuple(sorted(name for name in names if policies.get(name).built_in and not why_not(policies.get(name))))


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
        BufgymError: the policy has no C, a limit is invalid, or C has no names that begin so.
    """
    check_limits(capacity, max_bytes)
    if re.fullmatch("[a-z][a-z0-9_]*", prefix) is None:
        raise BufgymError(f"prefix {prefix!r}: must be small letters, digits and _, as names in C begin")
    if because := why_not(policy):
        raise BufgymError(f"policy {policy.name}: has no C: {because}; known: {', '.join(supported())}")
    program = Program(prefix="bufgym_", exported="static inline")
    program.known(record_kind(MESSAGE), "struct bufgym_message")
    for name, pointer in zip(_HOOKS[:3], signatures(), strict=False):
        program.hook(f"bufgym_{name}", getattr(policy, name), pointer)
    reals = array_kind(float, constant=True)
    program.hook("bufgym_value_of", qoi.value, Pointer((reals, FLOAT), FLOAT))
    of = {kind: program.maker(program.c_type(kind)) for kind in (reals, array_kind(MESSAGE), array_kind(TOPIC))}
    past = f"{of[reals]}(q->past, {PAST})"
    if policy.remembers:
        program.hook("bufgym_begin_past", begin_past, Pointer((array_kind(float), INT, FLOAT), None))
        noted = (array_kind(float), INT, INT, FLOAT, FLOAT, INT, INT, FLOAT)
        program.hook("bufgym_remember_past", remember_past, Pointer(noted, None))
    fixed, per_candidate = len(policy.memory) + policy.work[0], policy.work[1]
    size = f"{max(1, fixed)}" + f" + {per_candidate} * (BUFGYM_CAPACITY + 1)" * (per_candidate > 0)
    unlimited = max_bytes is None
    numbers: dict[str, Any] = {
        "ABOUT": _comment(policy.summary),
        "SOURCE": _comment(policy.source),
        "NAME": _comment(policy.name),
        "VERSION": __version__,
        "CAPACITY": capacity,
        "FOREVER": FOREVER,
        "UNLIMITED": UNLIMITED_BYTES,
        "MAX_BYTES": "BUFGYM_UNLIMITED" if unlimited else f"INT64_C({max_bytes})",
        "LIMIT": "no limit" if unlimited else max_bytes,
        "PAST": PAST,
        "BEGIN_PAST": f"        bufgym_begin_past({past}, q->now_us, arrival->x);\n" if policy.remembers else "",
        "REMEMBER_PAST": _REMEMBER.format(past) if policy.remembers else "",
        "MEMORY": _lines(policy.memory.values()),
        "MEMORY_SIZE": size,
        "MEMORY_PART": f"{of[reals]}(q->memory, {size})",
        "PARAMETERS": _lines(policy.parameter_array),
        "VALUE": _comment(value.name),
        "VALUE_ARRAY": _lines(value.array),
        "VALUE_SIZE": len(value.array),
        "V": f"{of[reals]}((double *)BUFGYM_V, BUFGYM_V_SIZE)",
        "POLICY": program.source(),
        "HEARS": int(policy.hears_departures),
        "DROPS": int(policy.drops_at_dequeue),
        "VIEW": program.c_type(view_kind()),
        "TOPIC": _topic(program, value),
    }
    seen = {name: f"q->{name}" for name in Buffer._fields} | _SEEN
    seen["slots"] = f"{of[array_kind(MESSAGE)]}(q->slots, q->occupancy)"
    seen["v"] = numbers["V"]
    seen["past"] = past
    seen["parameters"] = f"{of[reals]}((double *)bufgym_parameters, {len(policy.parameter_array)})"
    seen["topics"] = f"{of[array_kind(TOPIC)]}(&bufgym_topic, 1)"
    members = zip(program.members(view_kind()), Buffer._fields, strict=True)
    numbers["SEEN"] = "".join(f"    seen.{member} = {seen[name]};\n" for member, name in members)
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


def _topic(program: Program, value: Value) -> str:
    """The settings of the one topic, as a queue without topics shows them."""
    kind = record_kind(TOPIC)
    assert isinstance(kind, Record)
    row = Senders(1, 1, value, max_messages=1).topic_table[0]
    struct = program.c_type(kind).removesuffix(" *")
    return f"static {struct} bufgym_topic = {{{', '.join(repr(row[name].item()) for name in TOPIC.names or ())}}};"


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


def _lines(numbers: Iterable[float]) -> str:
    """Numbers exact to the last bit, five in a line; 0 where there is none, as C has no empty arrays."""
    found = [repr(float(number)) for number in numbers] or ["0.0"]
    return ",\n    ".join(", ".join(found[k : k + 5]) for k in range(0, len(found), 5))
