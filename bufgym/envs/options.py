"""The options that every environment takes, as one checked record with all defaults."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from bufgym import scenario as scenarios
from bufgym.ground.errors import BufgymError, unknown, unknown_argument
from bufgym.model.checks import whole
from bufgym.scenario import Scenario
from bufgym.scenario.registry import parameters

GUIDED = "guided"
ACTIONS = ("slots", GUIDED)  # What an action is: the slot that goes, or numbers of the rule
INFOS = ("full", "steady", "mask", "none")
"""How much ``info`` has: all, all plus the summary so far (the same entries in every step), the action mask alone, or
nothing. At an episode's end the summary is always there."""
MASKS = ("valid", "plausible")
"""Actions that the mask shows: all valid ones, or those of them that a good rule chooses among (``plausible``)."""
RENDER_MODES = ("ansi", "rgb_array")


@dataclass(frozen=True, kw_only=True)
class Options:
    """An environment's options beside its scenario. ``SenderEnv`` says what each of them means.

    A new option is a field here, with its check below, and a line in the docstring of ``SenderEnv``. Values that belong
    to one part of an environment are checked where that part is made: the queue's in ``Senders``, the fields' in
    ``ObservationForm``, the reward's in ``reward_weights``.
    """

    capacity: int = 8
    max_bytes: int | None = None
    decide_at: str = "arrival"
    reward: str | Mapping[str, float] = "retained"
    actions: str = "slots"
    mask: str = "valid"
    fields: str | Sequence[str] | None = None
    observation: str = "dict"
    info: str = "full"
    bound: bool = False
    pool: int | None = None
    num_threads: int = 1
    render_mode: str | None = None

    def __post_init__(self) -> None:
        if self.info not in INFOS:
            raise BufgymError(f"info = {self.info!r}: must be one of {', '.join(map(repr, INFOS))}")
        if not isinstance(self.actions, str) or self.actions not in ACTIONS:
            raise unknown("actions", str(self.actions), ACTIONS)
        if self.mask not in MASKS:
            raise BufgymError(f"mask = {self.mask!r}: must be one of {', '.join(map(repr, MASKS))}")
        if not isinstance(self.bound, bool | np.bool_):
            raise BufgymError(f"bound = {self.bound!r}: must be True or False")
        if self.render_mode is not None and self.render_mode not in RENDER_MODES:
            raise BufgymError(f"render_mode = {self.render_mode!r}: must be one of {list(RENDER_MODES)}")
        whole("num_threads", self.num_threads, 1)

    @property
    def acts_guided(self) -> bool:
        """Whether an action sets the numbers of a rule."""
        return self.actions == GUIDED

    @property
    def sees_guided(self) -> bool:
        """Whether an observation holds the inputs of that rule, and nothing else."""
        return isinstance(self.fields, str) and self.fields == GUIDED

    @property
    def shows_all(self) -> bool:
        """Whether ``info`` has all entries in every step."""
        return self.info in ("full", "steady")

    @property
    def shows_mask(self) -> bool:
        """Whether ``info`` has the action mask in every step."""
        return self.info != "none" and not self.acts_guided

    def check_without_own_queue(self, what: str) -> None:
        """Refuse options for one queue on a link of its own where the sender has ``what`` instead."""
        if self.bound:
            raise BufgymError(
                f"bound = True: the clairvoyant is known for one queue on a link of its own, not for {what}"
            )
        if self.mask == "plausible":
            raise BufgymError(f"mask = 'plausible': the plausible actions are known for one queue, not for {what}")
        if self.acts_guided or self.sees_guided:
            name = "actions" if self.acts_guided else "fields"
            raise BufgymError(f"{name} = {GUIDED!r}: the rule serves one queue on a link of its own, not {what}")


_NAMES = tuple(field.name for field in fields(Options))


def read_arguments(scenario: Any, **arguments: Any) -> tuple[Scenario, Options]:
    """The scenario, with the arguments that are its parameters, and the options, which are the others."""
    options = {name: arguments.pop(name) for name in _NAMES if name in arguments}
    spec = scenarios.get(scenario)
    known = parameters(spec)
    for name in arguments:
        if name not in known:
            raise unknown_argument(
                f"{type(spec).__name__}.__init__", name, [*known, *_NAMES, "max_episode_steps", "autoreset_mode"]
            )
    return scenarios.get(spec, **arguments), Options(**options)
