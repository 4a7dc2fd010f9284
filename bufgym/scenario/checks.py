"""Rules that parameters of scenarios share; each function raises a BufgymError that names the parameter."""

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bufgym import traces
from bufgym.model import qoi
from bufgym.model.checks import above_0, between
from bufgym.model.qoi import Value
from bufgym.traces import Motion, Trace
from bufgym.traces.generate.sizes import EQUAL, parsed
from bufgym.traces.trace import MAX_DURATION_S
from bufgym.traces.workload import MAX_MESSAGE_BYTES
from bufgym.utils import modules
from bufgym.utils.errors import BufgymError

MAX_RATE_HZ = 100_000  # Highest arrival rate: times are whole microseconds, at least ten to a period


def rate(rate_hz: Any) -> None:
    """Check that ``rate_hz`` is > 0, at most ``MAX_RATE_HZ``, and gives a message in the longest possible time."""
    above_0("rate_hz", rate_hz)
    if not 1 / MAX_DURATION_S <= rate_hz <= MAX_RATE_HZ:
        raise BufgymError(f"rate_hz = {rate_hz}: must be at most {MAX_RATE_HZ}, and at least {1 / MAX_DURATION_S:g}")


def up_to(name: str, value: Any, most: float) -> None:
    """Check that a parameter is > 0 and at most ``most``."""
    above_0(name, value)
    if value > most:
        raise BufgymError(f"{name} = {value}: must be at most {most}")


def check_stream(stream: Any) -> None:
    """Check the parameters of every stream of messages: rate_hz, size_bytes, jitter and size_cv."""
    rate(stream.rate_hz)
    up_to("size_bytes", stream.size_bytes, MAX_MESSAGE_BYTES)
    between("jitter", stream.jitter, 0, 1, "of a period")
    between("size_cv", stream.size_cv, 0, 10)


def check_sizes(stream: Any, moves: bool) -> None:
    """Check the parameter ``sizes`` of a stream, which moves or not; its ``size_cv`` must not be given too."""
    law, _, _ = parsed(stream.sizes)
    if law != EQUAL and getattr(stream, "size_cv", None):
        raise BufgymError(f"sizes = {stream.sizes!r}, size_cv = {stream.size_cv}: must not both be given")
    if law == "motion" and not moves:
        raise BufgymError(f"sizes = {stream.sizes!r}: needs a motion recording")


def check_value(scenario: object) -> None:
    """Check the parameter ``value``; text or a function becomes a ``Value`` (``qoi.load``)."""
    value = getattr(scenario, "value")  # noqa: B009  (every kind of scenario has it)
    if not isinstance(value, Value):
        object.__setattr__(scenario, "value", qoi.load(value))


def recordings(scenario: object) -> None:
    """Make tuples of Trace and Motion of the parameters ``traces`` and ``motion``, even of a single one.

    Text names a shipped recording, a file, or for traces a generator (``links``), or several with commas between. The
    motion "none" stands for none.
    """
    if getattr(scenario, "motion") in ("none", ["none"]):  # noqa: B009
        object.__setattr__(scenario, "motion", ())
    as_tuple(scenario, "traces", Trace, "a bufgym.traces Trace", links)
    as_tuple(scenario, "motion", Motion, "a bufgym.traces Motion", lambda text: [traces.load_motion(text)])


def as_tuple(
    scenario: object, name: str, kind: Any, what: str, load: Callable[[str], Sequence[Any]] | None = None
) -> None:
    """Make the parameter a tuple, even of a single item, and check its items; ``what`` names their kind in words.

    ``load`` makes items from one name in text (``names_in``).
    """
    value = getattr(scenario, name)
    items = list(value if isinstance(value, Sequence) and not isinstance(value, str | os.PathLike) else (value,))
    if load is not None:
        items = [
            made
            for item in items
            for named in ([item] if not isinstance(item, str | os.PathLike) else names_in(os.fspath(item)))
            for made in (load(named) if isinstance(named, str) else [named])
        ]
    for item in items:
        if not isinstance(item, kind):
            raise BufgymError(f"{name}: {item!r} is not {what}")
    object.__setattr__(scenario, name, tuple(items))


def names_in(text: str) -> list[str]:
    """The names between commas; a file that there is has a single name, commas and all."""
    return [text] if os.path.exists(text) else [name for part in text.split(",") if (name := part.strip())]


GENERATED = 8  # Links that a generator makes without given seeds
_GENERATOR = re.compile(r"([A-Za-z_][\w.]*:[A-Za-z_]\w*)(?::(\d+)-(\d+))?")


def links(text: str) -> list[Trace]:
    """The traces that text names: a shipped one, a file, or a generator, which is a function seed -> Trace.

    ``module:function:100-119`` names a generator and its seeds; the seeds of ``module:function`` are 0 to ``GENERATED``
    - 1. The module is imported (see ``bufgym.utils.modules``).
    """
    match = _GENERATOR.fullmatch(text)
    if match is None or Path(text).exists():
        return [traces.load(text)]
    name, first, last = match.groups()
    seeds = range(GENERATED) if first is None else range(int(first), int(last) + 1)
    if not 1 <= len(seeds) <= MAX_GENERATED:
        raise BufgymError(f"traces = {text!r}: needs 1 to {MAX_GENERATED} seeds, as in {name}:0-99")
    generate, made = modules.find(name), []
    for seed in seeds:
        trace = generate(seed) if callable(generate) else None
        if not isinstance(trace, Trace):
            raise BufgymError(f"traces = {text!r}: must be a function seed -> Trace; for seed {seed} it is {trace!r}")
        made.append(trace)
    return made


MAX_GENERATED = 10_000
