"""The one registry of drop policies, by name.

A policy is a plain function ``on_arrival(buffer, arrival, memory) -> decision`` and, where it keeps score of what
leaves, ``on_departure(buffer, memory)``; a queue discipline that drops at the head as well, as CoDel does, has
``on_dequeue(buffer, memory) -> drop it?``; a scheduler ``on_send(buffer, memory) -> slot or HOLD``. ``buffer`` is
``bufgym.model.buffer.Buffer``; ``arrival`` a MESSAGE record; ``memory`` a float64 array of the policy's own, laid out
and initialised as its registration says; the decision a slot to evict for the newcomer (0 = oldest), REJECT or ACCEPT.
``arrival.uniform`` is a uniform draw in [0, 1) for policies that randomise; the functions themselves are deterministic.

    from bufgym.policies import ACCEPT, register

    @register("keep-even", memory={"count": 0})
    def keep_even(buffer, arrival, memory):
        "Drops every second arrival that finds the queue full, the oldest otherwise."
        if len(buffer.slots) < buffer.capacity:
            return ACCEPT
        memory[0] += 1
        return 0 if memory[0] % 2 else REJECT

That name now works wherever the built-in ones do. Given ``compile=True`` the same function runs compiled.
"""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numba
import numpy as np
from numpy.typing import NDArray

from bufgym.errors import BufgymError
from bufgym.kernel import compile_for
from bufgym.model.buffer import MESSAGE, TOPIC, Buffer

OnArrival = Callable[[Buffer, Any, NDArray[np.float64]], int]
OnDeparture = Callable[[Buffer, NDArray[np.float64]], None]
OnDequeue = Callable[[Buffer, NDArray[np.float64]], bool]
OnSend = Callable[[Buffer, NDArray[np.float64]], int]
Foresee = Callable[[Any, int, int, Any], NDArray[np.float64]]


def _nothing(buffer: Buffer, memory: NDArray[np.float64]) -> None:
    """The departure hook of a policy that keeps no score of departures."""


def _keep(buffer: Buffer, memory: NDArray[np.float64]) -> bool:
    """The dequeue hook of a policy that drops nothing there."""
    return False


def _send_head(buffer: Buffer, memory: NDArray[np.float64]) -> int:
    """The scheduler of a policy that has none: first in, first out."""
    return 0


@dataclass(frozen=True)
class Client:
    """How the program around a policy sends, where that is not the policy's to decide."""

    encoding: str = ""
    """Which of an episode's encodings its messages have; empty for their own sizes."""
    awaits_acks: bool = True
    """Whether it keeps to the scenario's in-flight window n_T; else the socket takes whenever the link is free."""
    limit_at_send: bool = False
    """Whether rate limits hold messages back at the socket, keeping the latest, instead of dropping at arrival."""
    flush_no_drop: bool = False
    """Whether no_drop messages are sent even when the window is full."""
    copies: bool = False
    """Whether it sends one copy of every message to each consumer."""


@dataclass(frozen=True)
class Policy:
    """One drop policy: what decides, what it remembers, where it comes from."""

    name: str
    on_arrival: OnArrival
    on_departure: OnDeparture = _nothing
    on_dequeue: OnDequeue = _keep
    """Whether to drop the head that the socket is about to take; asked again about the next one if so."""
    on_send: OnSend = _send_head
    """Which slot the free socket takes, or HOLD: a scheduler."""
    memory: Mapping[str, float] = field(default_factory=dict)
    """Names and initial values of the memory's entries; those in ``parameters`` are its settings."""
    parameters: tuple[str, ...] = ()
    source: str = ""
    compile: bool = False
    unbounded: bool = False
    """Whether its queue grows without limit, whatever L is; no bound for L messages holds for it."""
    privileged: Foresee | None = None
    """(episode, L, B, V) -> memory: for policies that know what is coming, which no robot does."""
    work: tuple[int, int] = (0, 0)
    """Room to work in behind the memory's entries: so many numbers, and so many more for each of L + 1 candidates."""
    about: str = ""
    client: Client = Client()
    for_topics: bool = False
    """Whether it is made for several topics; in one queue it says little, and is left out unless it is named."""

    @property
    def schedules(self) -> bool:
        """Whether it chooses which message goes next."""
        return self.on_send is not _send_head

    @property
    def hears_departures(self) -> bool:
        """Whether departures change what it remembers."""
        return self.on_departure is not _nothing

    @property
    def drops_at_dequeue(self) -> bool:
        """Whether it is asked about each head before the socket takes it."""
        return self.on_dequeue is not _keep

    @property
    def unranked_because(self) -> str:
        """Why it does not compete with the others; empty if it does."""
        if self.unbounded:
            return "its queue is unbounded"
        return "it knows the future" if self.privileged is not None else ""

    @property
    def ranked(self) -> bool:
        """Whether it plays by the rules: L messages at most, nothing known beforehand."""
        return not self.unranked_because

    @property
    def summary(self) -> str:
        """What it does: the first line of the function's docstring, unless ``about`` says it."""
        return self.about or (inspect.getdoc(self.on_arrival) or "").split("\n")[0]

    @functools.cached_property
    def parameter_array(self) -> NDArray[np.float64]:
        """What its functions read as ``buffer.parameters``: float64[parameters], read-only."""
        numbers = np.array([self.memory[name] for name in self.parameters], np.float64)
        numbers.flags.writeable = False
        return numbers

    def new_memory(self, senders: int = 1, capacity: int = 0) -> NDArray[np.float64]:
        """Fresh memory for so many senders with L = ``capacity``, float64[senders, entries]."""
        start = np.array(list(self.memory.values()) or [0.0], np.float64)
        room = self.work[0] + self.work[1] * (capacity + 1)
        return np.tile(np.concatenate([start, np.zeros(room)]), (senders, 1))

    def with_parameters(self, **settings: float) -> Policy:
        """This policy with other settings, named accordingly; an error for an unknown name or an unusable number."""
        for name, number in settings.items():
            if name not in self.parameters:
                known = ", ".join(self.parameters) or "none"
                raise BufgymError(f"policy {self.name}: no parameter {name!r}; it has: {known}")
            if not (isinstance(number, int | float) and math.isfinite(number) and number > 0):
                raise BufgymError(f"policy {self.name}: {name} = {number!r}: must be a number > 0")
        if not settings:
            return self
        label = ",".join(f"{name}={number:g}" for name, number in settings.items())
        memory = {**self.memory, **{name: float(number) for name, number in settings.items()}}
        return replace(self, name=f"{self.name}:{label}", memory=memory)

    @functools.cached_property
    def compiled(self) -> tuple[OnArrival, OnDeparture, OnDequeue, OnSend]:
        """Its functions compiled for one signature each, so that one rollout kernel serves every policy."""
        return _compiled(self.on_arrival, self.on_departure, self.on_dequeue, self.on_send)


@functools.lru_cache(maxsize=256)
def _compiled(
    on_arrival: OnArrival, on_departure: OnDeparture, on_dequeue: OnDequeue, on_send: OnSend
) -> tuple[OnArrival, OnDeparture, OnDequeue, OnSend]:
    """Once for all policies that share these functions, whatever their parameters or weights."""
    arrival, departure, dequeue, send = signatures()
    return (
        compile_for(arrival, on_arrival),
        compile_for(departure, on_departure),
        compile_for(dequeue, on_dequeue),
        compile_for(send, on_send),
    )


@functools.cache
def signatures() -> tuple[Any, Any, Any, Any]:
    """Numba types of ``on_arrival``, ``on_departure``, ``on_dequeue`` and ``on_send``."""
    message, topic = numba.from_dtype(MESSAGE), numba.from_dtype(TOPIC)
    int_, real = numba.types.int64, numba.types.float64
    reals, constants = numba.types.Array(real, 1, "C"), numba.types.Array(real, 1, "C", readonly=True)
    types = {
        "slots": numba.types.Array(message, 1, "C"),
        "v": constants,
        "parameters": constants,
        "topics": numba.types.Array(topic, 1, "C"),
    }
    reals_of = {"dequeued_x", "previous_x", "left_fraction", "period_us", "service_ratio"}
    view = cast(Any, numba.types).NamedTuple(
        tuple(types.get(name, real if name in reals_of else int_) for name in Buffer._fields), Buffer
    )
    return (
        int_(view, message, reals),
        numba.types.void(view, reals),
        numba.types.boolean(view, reals),
        int_(view, reals),
    )


_REGISTRY: dict[str, Policy | Callable[[], Policy]] = {}
"""By name: a policy, or what makes it when it is first asked for."""
_LATER_FOR_TOPICS: set[str] = set()
"""Names of those to be made that are for topics."""


def register(
    name: str,
    *,
    memory: Mapping[str, float] | None = None,
    parameters: tuple[str, ...] = (),
    on_departure: OnDeparture = _nothing,
    on_dequeue: OnDequeue = _keep,
    on_send: OnSend = _send_head,
    source: str = "",
    compile: bool = False,
    unbounded: bool = False,
    privileged: Foresee | None = None,
    client: Client | None = None,
    for_topics: bool = False,
) -> Callable[[OnArrival], OnArrival]:
    """Register the decorated function as the policy ``name``; it comes back unchanged.

    ``compile=True`` promises that Numba can compile it; else it runs as ordinary Python wherever policies run.
    """
    known = _REGISTRY.get(name)
    if known and (not isinstance(known, Policy) or known.on_arrival.__module__.startswith("bufgym.")):
        raise BufgymError(f"policy {name!r}: a built-in policy has this name")
    if not name or any(c in ":,= \t\n" for c in name):
        raise BufgymError(f"policy {name!r}: a name must be non-empty, without spaces, ':', ',' or '='")
    unknown = set(parameters) - set(memory or {})
    if unknown:
        raise BufgymError(f"policy {name!r}: parameters {sorted(unknown)} are not entries of its memory")

    def add(on_arrival: OnArrival) -> OnArrival:
        if not callable(on_arrival):
            raise BufgymError(f"policy {name!r}: {on_arrival!r} is not a function")
        _REGISTRY[name] = Policy(
            name,
            on_arrival,
            on_departure,
            on_dequeue,
            on_send,
            dict(memory or {}),
            parameters,
            source,
            compile,
            unbounded,
            privileged,
            client=client or Client(),
            for_topics=for_topics,
        )
        return on_arrival

    return add


def register_later(name: str, make: Callable[[], Policy], *, for_topics: bool = False) -> None:
    """Register a policy that is made when it is first asked for; a name that is taken stays as it is."""
    if _REGISTRY.setdefault(name, make) is make and for_topics:
        _LATER_FOR_TOPICS.add(name)


def names(*, for_topics: bool | None = None) -> Iterator[str]:
    """All registered names, in the order of their registration; True: those made for topics only, False: the others."""
    made = {name for name, known in _REGISTRY.items() if isinstance(known, Policy) and known.for_topics}
    made |= _LATER_FOR_TOPICS
    return iter([name for name in _REGISTRY if for_topics in (None, name in made)])


def get(spec: str | Policy) -> Policy:
    """The policy that ``spec`` names: ``"afr"``, or with settings ``"decimate:every=2"``."""
    if isinstance(spec, Policy):
        return spec
    name, _, settings = spec.partition(":")
    if name not in _REGISTRY:
        raise BufgymError(f"unknown policy {name!r}; known: {', '.join(_REGISTRY)}")
    numbers: dict[str, float] = {}
    for setting in filter(None, settings.split(",")):
        key, _, number = setting.partition("=")
        try:
            numbers[key.strip()] = float(number)
        except ValueError:
            raise BufgymError(f"policy {spec!r}: {setting!r} is not of the form parameter=number") from None
    found = _REGISTRY[name]
    if not isinstance(found, Policy):
        found = _REGISTRY[name] = found()
    return found.with_parameters(**numbers)


def runs_compiled(policy: Policy) -> bool:
    """Whether this policy's functions run inside compiled rollouts."""
    return policy.compile
