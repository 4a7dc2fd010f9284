"""The options that every environment takes, as one checked record with all defaults."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import gymnasium as gym

from bufgym import scenario as scenarios
from bufgym.model.checks import flag, whole
from bufgym.model.observe.candidates import MOST_CANDIDATES
from bufgym.policies import Policy
from bufgym.scenario import Scenario
from bufgym.scenario.registry import parameters
from bufgym.utils.errors import BufgymError, UnknownArgumentError, unknown

if TYPE_CHECKING:
    from bufgym.envs.render import Window

CANDIDATES, SLOTS = "candidates", "slots"
ACTIONS = (CANDIDATES, SLOTS)  # What an action is: the candidate or the slot that goes
INFOS = ("full", "summary", "mask")
RENDER_MODES = ("ansi", "rgb_array", "human")
_CHOICES = {"info": INFOS, "observation": ("dict", "flat", None), "render_mode": (*RENDER_MODES, None)}


class InvalidActionError(BufgymError, gym.error.InvalidAction):
    """An action outside of its space; also Gymnasium's ``InvalidAction``."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """An environment's options beside its scenario.

    A new option is a field here, with its meaning and its check. Values that belong to one part of an environment are
    checked where that part is made: the queue's in ``Senders``, the fields' in ``ObservationForm``, the reward's in
    ``reward_weights``.
    """

    capacity: int = 8
    """L, messages."""
    max_bytes: int | None = None
    """B, bytes; None for no limit."""
    decide_at: str | None = None
    """When to ask: "overflow" only when the buffer is full, the default of candidates; "arrival" at every arrival, the
    default of slots."""
    reward: str | Mapping[str, float] | None = None
    """A term's name, or weights by name; terms outside ``REWARD_TERMS`` take part only if named. By default "paired" of
    one queue with a link of its own, and "retained" of several topics and of robots that share a link."""
    reference: str | Policy = "min-motion-gap"
    """The rule of ``paired``, a compiled policy or its name; "min-motion-gap" always drops the cheapest."""
    actions: str = CANDIDATES
    """What an action is: "candidates", for one queue, or "slots", the only one of several topics."""
    candidates: int = 2
    """How many of the cheapest candidates are actions beside the head, 1 to 64."""
    repeat: int = 1
    """An action holds for so many decisions. At each of them its place in the order of candidates is looked up anew.
    Rewards add up over them, and an episode's end cuts them short. For candidates."""
    fields: Sequence[str] | None = None
    """With candidates, names of fields to observe beside the 27 numbers, your own or those of ``ON_BOARD_FIELDS``. With
    slots, names of all fields to observe, by default those of the tables."""
    observation: str | None = None
    """Form: "flat", the default of candidates, or "dict", the default of slots."""
    info: str = "full"
    """How much ``info`` has: "full"; "summary" adds the summary so far in every step, for recorders; "mask" has the
    mask and the candidates' slots alone, and at an episode's end its summary."""
    bound: bool = False
    """Whether the last ``info`` also has ``clairvoyant``, ``certified``, ``regret`` and ``score``, for one queue."""
    num_threads: int = 1
    """Threads that share the environments of a batch; they do not change results."""
    render_mode: str | None = None
    """Drawing: "ansi", "rgb_array", or "human" for a window that shows each step (extra ``human``)."""

    def __post_init__(self) -> None:
        for name, known in _CHOICES.items():
            if (given := getattr(self, name)) not in known:
                raise BufgymError(f"{name} = {given!r}: must be one of {', '.join(map(repr, known))}")
        if not isinstance(self.actions, str) or self.actions not in ACTIONS:
            raise unknown("actions", str(self.actions), ACTIONS)
        whole("candidates", self.candidates, 1, MOST_CANDIDATES)
        whole("repeat", self.repeat, 1)
        if self.repeat > 1 and not self.acts_on_candidates:
            raise BufgymError(f"repeat = {self.repeat}: for candidates, whose order an action keeps; not for slots")
        names: Any = () if self.fields is None else self.fields
        is_list = isinstance(names, Collection) and not isinstance(names, str)
        if not (is_list and all(isinstance(name, str) for name in names)):
            raise BufgymError(f"fields = {names!r}: must be a list of names")
        flag("bound", self.bound)
        whole("num_threads", self.num_threads, 1)

    def window(self) -> "Window | None":
        """A window that shows each step, for the ``render_mode`` "human"."""
        if self.render_mode != "human":
            return None
        from bufgym.envs.render import Window  # loaded only to draw

        return Window()

    def reward_of(self, own_queue: bool) -> str | Mapping[str, float]:
        """``reward``, or the default of one queue with a link of its own, or of anything else."""
        return self.reward if self.reward is not None else ("paired" if own_queue else "retained")

    @property
    def acts_on_candidates(self) -> bool:
        """Whether an action is one of a few ordered candidates."""
        return self.actions == CANDIDATES

    @property
    def asked_at(self) -> str:
        """When it is asked: ``decide_at``, by default "overflow" for candidates and "arrival" for slots."""
        return self.decide_at or ("overflow" if self.acts_on_candidates else "arrival")

    @property
    def form(self) -> str:
        """Form of an observation: ``observation``, by default "flat" for candidates and "dict" for slots."""
        return self.observation or ("flat" if self.acts_on_candidates else "dict")

    @property
    def shows_all(self) -> bool:
        """Whether ``info`` has all entries in every step."""
        return self.info in ("full", "summary")

    def check_without_own_link(self, what: str) -> None:
        """Refuse options for one queue on a link of its own where the sender has ``what`` instead."""
        if self.bound:
            raise BufgymError(
                f"bound = True: the clairvoyant is known for one queue on a link of its own, not for {what}"
            )
        if self.repeat > 1:
            raise BufgymError(f"repeat = {self.repeat}: for one queue on a link of its own, not for {what}")

    def check_without_own_queue(self, what: str) -> None:
        """The same, and refuse candidates, which are of one queue."""
        self.check_without_own_link(what)
        if self.acts_on_candidates:
            raise BufgymError(f"actions = {CANDIDATES!r}: known for one queue on a link of its own, not for {what}")


_NAMES = tuple(field.name for field in fields(Options))
_OF_BATCHES = ("max_episode_steps", "autoreset_mode")
_OTHER_NAMES = {
    "L": "capacity",
    "buffer_size": "capacity",
    "fps": "rate_hz",
    "seconds": "duration_s",
    "size": "size_bytes",
    "bytes": "size_bytes",
}
"""What else one may call an argument -> the argument."""
_ELSEWHERE = {
    "seed": "a seed goes to reset(seed=...)",
    "suite": "bufgym/Suite-v1 takes it",
    "split": "bufgym/Suite-v1 takes it",
}


def _unknown(name: str, known: Sequence[str]) -> str:
    """Say what was meant by an argument that a scenario and the options do not have, or who takes it."""
    if name in _OF_BATCHES:
        return f"a batch takes it; Gymnasium's SyncVectorEnv by vector_kwargs={{{name!r}: ...}}"
    meant = _OTHER_NAMES.get(name)
    if name in _ELSEWHERE or meant in known:
        return f"unknown argument {name!r}; {_ELSEWHERE.get(name) or f'did you mean {meant!r}?'}"
    return str(unknown("argument", name, known))


def read_arguments(scenario: Any, **arguments: Any) -> tuple[Scenario, Options]:
    """The scenario, with the arguments that are its parameters, and the options, which are the others."""
    options = {name: arguments.pop(name) for name in _NAMES if name in arguments}
    spec = scenarios.get(scenario)
    if spec.topics:
        options.setdefault("actions", SLOTS)
    known = parameters(spec)
    for name in arguments:
        if name not in known:
            ours = _unknown(name, [*known, *_NAMES, *_OF_BATCHES])
            raise UnknownArgumentError(
                f"{type(spec).__name__}.__init__() got an unexpected keyword argument {name!r}: {ours}"
            )
    return scenarios.get(spec, **arguments), Options(**options)
