"""The one registry of drop policies, by name.

A policy is a plain function ``on_arrival(buffer, arrival, memory) -> decision``, with up to three further functions:

    on_departure(buffer, memory)           is told of each message that leaves the buffer for the socket
    on_dequeue(buffer, memory) -> bool     says whether to drop the head that the socket is about to take, as CoDel does
    on_send(buffer, memory) -> slot        chooses the message to send next, or HOLD: a scheduler

``buffer`` is a ``bufgym.model.buffer.Buffer``, ``arrival`` a MESSAGE record. A decision is REJECT, ACCEPT or the slot
to evict for the newcomer, 0 being the oldest. Settings are ``parameters``, which a user sets by name as in
``keep-even:every=3``; functions read them as ``buffer.parameters``. State is ``memory``, a float64 array for each
sender. Both follow the order of the registration. ``arrival.uniform`` is a uniform draw in [0, 1) for policies that
randomise; the functions themselves are deterministic.

docs/guide/own-policy.md has an example. The name then works like a built-in one's; ``compile=True`` compiles it.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, NamedTuple, cast, get_type_hints

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import compile_signature
from bufgym.kernels.kinds import BOOL, FLOAT, INT, Pointer, Tuple, array_kind, record_kind
from bufgym.model.buffer import MESSAGE, TOPIC, Buffer
from bufgym.model.checks import changed, check_name, constants
from bufgym.utils.errors import BufgymError, unknown
from bufgym.utils.modules import first_line, takes
from bufgym.utils.settings import named_settings

Arrival = Any
"""A MESSAGE record."""
Memory = NDArray[np.float64]
"""float64[entries]: a policy's state at one sender."""
OnArrival = Callable[[Buffer, Arrival, Memory], int]
OnDeparture = Callable[[Buffer, Memory], None]
OnDequeue = Callable[[Buffer, Memory], bool]
OnSend = Callable[[Buffer, Memory], int]
Privileged = Callable[[Any, int, int, Any], Memory]
Functions = tuple[OnArrival, OnDeparture, OnDequeue, OnSend]


_TAKES = {
    "on_arrival": ("buffer", "arrival", "memory"),
    **dict.fromkeys(("on_departure", "on_dequeue", "on_send"), ("buffer", "memory")),
}
"""The arguments of each function of a policy."""


def _ignore(buffer: Buffer, memory: Memory) -> None:
    """The ``on_departure`` of a policy that ignores departures."""


def _keep(buffer: Buffer, memory: Memory) -> bool:
    """The ``on_dequeue`` of a policy that never drops there."""
    return False


def _send_head(buffer: Buffer, memory: Memory) -> int:
    """The ``on_send`` of a policy that is no scheduler: first in, first out."""
    return 0


@dataclass(frozen=True)
class ClientSettings:
    """How the client program around a policy sends, as far as the policy does not decide it."""

    encoding: str = ""
    """The episode's encoding of its messages; empty for their own sizes."""
    awaits_acks: bool = True
    """Whether it keeps to the scenario's in-flight window n_T; if not, it sends whenever the link is free."""
    limit_at_send: bool = False
    """Whether rate limits hold messages back at the socket, keeping the latest, instead of dropping at arrival."""
    limit_since_sent: bool = False
    """Whether rate limits at arrival count from the topic's message sent last, not from the one kept last."""
    flush_no_drop: bool = False
    """Whether no_drop messages are sent even when the window is full."""
    copies: bool = False
    """Whether it sends one copy of every message to each consumer."""


@dataclass(frozen=True)
class Policy:
    """A drop policy: the functions that decide, their parameters and memory, and its source."""

    name: str
    """Unique in the registry; after ``with_parameters`` it also names the settings."""
    on_arrival: OnArrival
    """(buffer, arrival, memory) -> REJECT, ACCEPT or the slot to evict for the newcomer."""
    _: KW_ONLY
    on_departure: OnDeparture = _ignore
    """(buffer, memory), called after the socket has taken a message."""
    on_dequeue: OnDequeue = _keep
    """(buffer, memory) -> whether to drop the head that the socket is about to take; if so, it is called again."""
    on_send: OnSend = _send_head
    """(buffer, memory) -> the slot that the free socket takes, or HOLD."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    """Names and values of its settings, which its functions read as ``buffer.parameters``."""
    weights: tuple[float, ...] = ()
    """Numbers of a learned policy, which has no settings; its functions read them as ``buffer.parameters``."""
    memory: Mapping[str, float] = field(default_factory=dict)
    """Names and initial values of the memory's entries."""
    work: tuple[int, int] = (0, 0)
    """Scratch entries after the memory: a fixed count, and a count for each of L + 1 candidates."""
    source: str = ""
    """The paper, specification or program that it follows."""
    about: str = ""
    """A sentence on its rule; empty to take the first line of ``on_arrival``'s docstring."""
    compile: bool = False
    """Promises that its functions are kernels; otherwise they run as ordinary Python."""
    unbounded: bool = False
    """Whether its queue grows without limit, whatever L is; bounds for L messages do not hold for it."""
    privileged: Privileged | None = None
    """(episode, L, B, V) -> memory, for policies that know the future, as no robot does."""
    built_in: bool = False
    """Whether its functions are bufgym's own; ``register`` then keeps its name."""
    reads_rate: bool = False
    """Whether a built-in policy reads the link's rate, which takes time to measure. Others may always read it."""
    reads_past: bool = False
    """The same for the past of link and camera, ``buffer.past``."""
    reads_left: bool = False
    """The same for the bytes left in the socket."""
    client: ClientSettings = ClientSettings()
    """How the program around it sends."""
    for_topics: bool = False
    """Whether it is made for several topics; on one queue it is left out unless named."""
    named_only: bool = False
    """Whether ``names`` leaves it out, as it can't play everywhere."""

    def __post_init__(self) -> None:
        for name, arguments in _TAKES.items():
            function = getattr(self, name)
            if function is not getattr(type(self), name, None) and not takes(function, len(arguments)):
                has = f"{getattr(function, '__name__', 'function')}{inspect.signature(function)}"
                raise BufgymError(f"policy {self.name!r}: {name} = {has}: must take ({', '.join(arguments)})")

    @property
    def schedules(self) -> bool:
        """Whether it chooses the message to send next."""
        return self.on_send is not _send_head

    @property
    def hears_departures(self) -> bool:
        """Whether ``on_departure`` is called."""
        return self.on_departure is not _ignore

    @property
    def drops_at_dequeue(self) -> bool:
        """Whether ``on_dequeue`` is called."""
        return self.on_dequeue is not _keep

    @property
    def measures(self) -> bool:
        """Whether the link's rate must be measured for it."""
        return self.reads_rate or self.remembers

    @property
    def remembers(self) -> bool:
        """Whether the past of link and camera must be kept for it."""
        return self.reads_past or not self.built_in

    @property
    def unranked_because(self) -> str:
        """The reason why it does not compete with the others; empty if it does."""
        if self.unbounded:
            return "its queue is unbounded"
        return "it knows the future" if self.privileged is not None else ""

    @property
    def ranked(self) -> bool:
        """Whether it competes: at most L messages, and no knowledge of the future."""
        return not self.unranked_because

    @property
    def summary(self) -> str:
        """Its rule in a sentence: ``about``, or the first line of the function's docstring."""
        return self.about or first_line(self.on_arrival)

    @property
    def parameter_array(self) -> NDArray[np.float64]:
        """Numbers for ``buffer.parameters``: float64[parameters], read-only."""
        return constants(self.weights or self.parameters.values())

    def new_memory(self, senders: int = 1, capacity: int = 0) -> NDArray[np.float64]:
        """Make fresh memory for ``senders`` senders with L = ``capacity``, float64[senders, entries]."""
        scratch, per_candidate = self.work
        entries = len(self.memory) + scratch + per_candidate * (capacity + 1)
        memory = np.zeros((senders, max(1, entries)))
        memory[:, : len(self.memory)] = list(self.memory.values())
        return memory

    def with_parameters(self, **settings: float) -> Policy:
        """This policy with other settings and a new name; raises for an unknown name or an unusable number."""
        parameters = changed(f"policy {self.name}", self.parameters, settings)
        if not settings:
            return self
        label = ",".join(f"{name}={_written(number)}" for name, number in settings.items())
        return replace(self, name=f"{self.name}:{label}", parameters=parameters)

    @functools.cached_property
    def compiled(self) -> Functions:
        """Its functions compiled for one signature each, so that one rollout kernel serves every policy."""
        return _compiled(self.on_arrival, self.on_departure, self.on_dequeue, self.on_send)


def _written(number: float) -> str:
    """A setting in a policy's name. The number is in it whole, as other processes know the policy by its name."""
    short = f"{number:g}"
    return short if float(short) == number else repr(float(number))


@functools.lru_cache(maxsize=256)
def _compiled(*functions: Any) -> Functions:
    """Compile once for all policies that share these functions, whatever their parameters or weights.

    A function that is a kernel already is compiled again from its text, for the one signature.
    """
    plain = [getattr(function, "py_func", function) for function in functions]
    return cast(Functions, tuple(map(compile_signature, signatures(), plain)))


@functools.cache
def view_kind() -> Tuple:
    """The kind of a ``Buffer``."""
    constants = array_kind(float, constant=True)
    kinds: dict[str, Any] = {
        "slots": array_kind(MESSAGE),
        "v": constants,
        "parameters": constants,
        "past": array_kind(float),
    }
    kinds |= {"topics": array_kind(TOPIC)}
    kinds |= {name: FLOAT for name, kind in get_type_hints(Buffer).items() if kind is float}
    return Tuple(tuple(kinds.get(name, INT) for name in Buffer._fields), Buffer._fields, "Buffer")


@functools.cache
def signatures() -> tuple[Pointer, Pointer, Pointer, Pointer]:
    """Kinds of ``on_arrival``, ``on_departure``, ``on_dequeue`` and ``on_send``."""
    view, memory = view_kind(), array_kind(float)
    return (
        Pointer((view, record_kind(MESSAGE), memory), INT),
        Pointer((view, memory), None),
        Pointer((view, memory), BOOL),
        Pointer((view, memory), INT),
    )


class Later(NamedTuple):
    """A policy that is made at its first use."""

    make: Callable[[], Policy]
    for_topics: bool  # as in ``Policy``, like the others
    named_only: bool
    built_in: bool = True


_REGISTRY: dict[str, Policy | Later] = {}


def register(name: str, /, **fields: Any) -> Callable[[OnArrival], OnArrival]:
    """Register the decorated function as the policy ``name``; it comes back unchanged.

    Keywords are the fields of ``Policy``: ``parameters``, ``memory``, ``on_departure``, ``compile`` and so on.
    A function may replace itself, as a notebook's cell runs again.

    Raises:
        BufgymError: the name is empty, holds one of ``:,=`` or a blank, or another policy has it.
    """
    known = _REGISTRY.get(name)
    if known is not None and known.built_in:
        raise BufgymError(f"policy {name!r}: a built-in policy has this name")
    check_name("policy", name)

    def add(on_arrival: OnArrival) -> OnArrival:
        if not callable(on_arrival):
            raise BufgymError(f"policy {name!r}: {on_arrival!r} is not a function")
        known = _REGISTRY.get(name)
        if isinstance(known, Policy) and _place(known.on_arrival) != _place(on_arrival):
            raise BufgymError(f"policy {name!r}: the function {_place(known.on_arrival)} has this name")
        policy = Policy(name, on_arrival, **fields)
        for what, entries in (("parameters", policy.parameters), ("memory", policy.memory)):
            if not isinstance(entries, Mapping):
                raise BufgymError(f"policy {name!r}: {what} = {entries!r}: must map names to numbers")
        _REGISTRY[name] = policy
        return on_arrival

    return add


def _place(function: OnArrival) -> str:
    """Where a function is defined."""
    return f"{function.__module__}.{function.__qualname__}"


built_in = functools.partial(register, compile=True, built_in=True)
"""The same for bufgym's own policies, which run compiled."""


def register_later(
    name: str, make: Callable[[], Policy], *, for_topics: bool = False, named_only: bool = False
) -> None:
    """Register a policy that is made at its first use; an existing entry of this name stays."""
    _REGISTRY.setdefault(name, Later(make, for_topics, named_only))


def names(*, for_topics: bool | None = None, named_only: bool = False) -> Iterator[str]:
    """All registered names, in the order of their registration.

    ``for_topics`` selects policies made for topics only (True) or the others (False). ``named_only`` gives instead the
    policies that take part only where they are named.
    """
    entries = tuple(_REGISTRY.items())
    return (name for name, e in entries if e.named_only == named_only and for_topics in (None, e.for_topics))


def get(spec: str | Policy | OnArrival) -> Policy:
    """The policy that ``spec`` names: ``"afr"``, or with settings ``"decimate:every=2"``.

    An unregistered policy function makes a policy of its own name.
    """
    if isinstance(spec, Policy):
        return spec
    if not isinstance(spec, str):
        if not inspect.isfunction(spec):
            raise BufgymError(f"policy {spec!r}: must be a name, a Policy, or a function (buffer, arrival, memory)")
        return registered_as(spec) or Policy(spec.__name__, spec)
    name = spec.partition(":")[0]
    if name not in _REGISTRY:
        raise unknown("policy", name, _REGISTRY)
    _, numbers = named_settings("policy", spec)
    entry = _REGISTRY[name]
    if isinstance(entry, Later):
        made = entry.make()
        if made.name != name:
            raise BufgymError(f"policy {name!r}: its file names it {made.name!r}: must be the same")
        entry = _REGISTRY[name] = replace(made, named_only=entry.named_only, built_in=True)
    return entry.with_parameters(**numbers)


def registered_as(function: OnArrival) -> Policy | None:
    """The policy that ``register`` made of this function, the first of several, or None."""
    made = (entry for entry in _REGISTRY.values() if isinstance(entry, Policy))
    return next((policy for policy in made if policy.on_arrival is function), None)
