"""SubEnvs, the base of every environment: n senders, the arrays they return, and one compiled step over all of them.

``SubEnvs`` has a link for each sender; in ``fleet_sub_envs`` the robots of a cell share one.
"""

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from numpy.typing import NDArray

from bufgym.envs.cost import Charges
from bufgym.envs.observation import Observation, ObservationForm
from bufgym.envs.options import InvalidActionError, Options
from bufgym.envs.output import BufferPool, StepOutput, new_choices
from bufgym.envs.own import Beside
from bufgym.envs.reward import reward_weights
from bufgym.envs.step import step_rows
from bufgym.jit import Repeated
from bufgym.model.observe import (
    BUILT_IN,
    CANDIDATE_FIELDS,
    CONTEXT_FIELDS,
    QUEUE_FIELDS,
    SLOT_FIELDS,
    TOPIC_CONTEXT_FIELDS,
    TOPIC_SLOT_FIELDS,
    own_field,
    terms_for,
)
from bufgym.oracle.measure import MEASURED, measured
from bufgym.scenario import Scenario, Streams
from bufgym.scenario.numbered import numbered
from bufgym.sim import Senders
from bufgym.sim.senders import Begun
from bufgym.utils.errors import BufgymError, unknown
from bufgym.utils.threads import Threads

NO_ACTIONS: NDArray[np.int64] = np.zeros(0, np.int64)
"""Argument of ``step_rows`` and ``step_cells`` where episodes begin."""

NUMBERED = ("scenario", "trace", "seed")
"""Options that name an episode of a benchmark; see ``bufgym.scenario.numbered``."""


def check_entries(names: Mapping[str, Any], known: Sequence[str], place: str) -> None:
    """Check that ``names`` is a dict of ``known`` entries alone; errors call it ``place``."""
    if not isinstance(names, Mapping):
        raise BufgymError(f"{place} = {names!r}: must be a dict of {', '.join(known)}")
    for name in names:
        if name not in known:
            raise unknown("entry", name, known, place=place)


class SubEnvs:
    """n senders, each with its own random streams, stepped together.

    ``output``, a ``StepOutput``, has the results of the last step. ``rewarded``, float64[n, reward terms], sums each
    reward term over the episode so far. ``weights``, float64[reward terms], are the terms' factors in the reward.
    """

    keeps_slots = False  # whether slot fields are computed even where none is observed
    own_links = True  # whether each queue has a link of its own

    def __init__(self, n: int, scenario: Scenario, options: Options) -> None:
        several_topics = bool(scenario.topics)
        if several_topics:
            options.check_without_own_queue("several topics")
        self.scenario, self.options = scenario, options
        self._shows_all = options.shows_all
        self._adds_summary = options.info == "summary"
        self.senders = Senders(
            n,
            options.capacity,
            scenario.value,
            max_messages=scenario.max_messages,
            max_bytes=options.max_bytes,
            decide_at=options.asked_at,
            topics=scenario.topics,
        )
        self.capacity = self.senders.capacity
        self.streams: list[Streams | None] = [None] * n
        self._threads = Threads(np.arange(n), options.num_threads)
        self._again = [Repeated() for _ in self._threads.parts]
        self._begin = Repeated()
        self._begun: dict[int, NDArray[np.int64]] = {}  # length -> rows that begin an episode
        self._actions = np.zeros(n, np.int64)

        self.choices = None
        self.actions_count = self.capacity + 2
        if options.acts_on_candidates:
            self.choices = new_choices(n, options.candidates, options.asked_at == "arrival")
            self.actions_count = options.candidates + 1 + (options.asked_at == "arrival")
        self.action_space: Any = spaces.Discrete(self.actions_count)

        self.weights, own_terms = reward_weights(
            options.reward_of(self.own_links and not several_topics), several_topics
        )
        self.terms = terms_for(several_topics) + own_terms
        self._term_names = names = [term.name for term in self.terms]
        self.rewarded = np.zeros((n, len(names)))
        self._charges = Charges(self.senders, names, options.reference)

        self.form = self._observed()
        self.observation_space = self.form.space
        self._rows = None if self.form.form == "flat" else BufferPool(self._new_row)
        self._beside = Beside(self.senders, self.form, own_terms, names)
        self.output = self.new_output()

    def _observed(self) -> ObservationForm:
        """The fields to observe. A step computes whole tables: all of one queue's unless fields are named.

        With several topics it leaves out the slot fields if none of them is observed.
        """
        options, several_topics = self.options, bool(self.scenario.topics)
        if self.choices is not None:
            return ObservationForm(
                options.form, CANDIDATE_FIELDS, QUEUE_FIELDS, self.capacity, options.fields,
                candidates=options.candidates,
            )  # fmt: skip
        slot_fields = SLOT_FIELDS + (TOPIC_SLOT_FIELDS if several_topics else ())
        context_fields = CONTEXT_FIELDS + (TOPIC_CONTEXT_FIELDS if several_topics else ())
        chosen = options.fields
        slots, context = ({field.name for field in fields} for fields in (slot_fields, context_fields))
        beside = context | ({*BUILT_IN} - slots)
        only_chosen = chosen is not None and not several_topics and not self.keeps_slots
        if several_topics and not self.keeps_slots and chosen and all(n in beside or own_field(n) for n in chosen):
            slot_fields = ()
        return ObservationForm(
            options.form, slot_fields, context_fields, self.capacity, chosen, only_chosen=only_chosen
        )

    def __len__(self) -> int:
        return len(self.senders)

    @property
    def unreached_steps(self) -> int:
        """A number of steps that no episode reaches.

        Each arrival asks, and asks again after an eviction if B is limited. With several topics a free socket asks for
        each message sent, and after a hold at most at each arrival and ack.
        """
        asks = 1 + (self.options.max_bytes is not None) + 3 * bool(self.scenario.topics)
        return asks * self.scenario.max_messages + 1

    def new_output(self) -> StepOutput:
        """Make zeroed arrays for the results of a step."""
        n = len(self)
        return StepOutput(
            np.zeros((n, self.form.numbers), np.float32),
            np.zeros((n, self.actions_count), np.int8),
            np.zeros((n, len(self.terms))),
            self.weights.copy(),
            np.zeros(n),
            np.zeros(n),
            np.zeros(n, np.int64),
            np.zeros(n, np.bool_),
            np.full(1, self.form.has_slots, np.int64),
            np.zeros((n, self.actions_count if self.choices else 0), np.int64),
        )

    def seed(self, i: int, rng: np.random.Generator) -> None:
        """Give sub-environment ``i`` streams of its own, derived from the generator that Gymnasium seeded."""
        self.streams[i] = Streams.seeded(int(rng.integers(2**63)))

    def reset(self, rows: NDArray[np.int64], episodes: Sequence[Any] | None = None) -> None:
        """Begin a new episode in each of ``rows``: the given one, or the next of its streams where that is None."""
        loaded = self._load(rows, episodes)
        self._beside.load(rows)
        if (same := self._begun.get(len(loaded))) is None:  # a call is repeated with the same arrays
            same = self._begun[len(loaded)] = np.empty_like(loaded)
        same[:] = loaded
        self._run(self._begin, same, NO_ACTIONS)
        if self._beside.has_any:
            self._beside.begin(rows, self.output)

    def step(self, actions: NDArray[np.int64]) -> None:
        """Take one decision in every sub-environment; the result is in ``self.output``."""
        self._actions[:] = actions
        if len(self._again) == 1:
            self._run(self._again[0], self._threads.parts[0], self._actions)
        else:
            self._threads.each(lambda part, rows: self._run(self._again[part], rows, self._actions))
        if self._beside.has_any:
            self._beside.write(self.output)

    def _load(self, rows: NDArray[np.int64], episodes: Sequence[Any] | None) -> NDArray[np.int64]:
        """Load ``episodes[i]`` into each of ``rows``; return what ``_run`` is to step.

        An episode may be a dict of arguments for ``numbered``.
        """
        if episodes is not None and (not isinstance(episodes, Sequence) or len(episodes) != len(self)):
            raise BufgymError(
                f"episodes = {episodes!r}: must be a list of {len(self)}, one for each environment; None to draw one"
            )
        begun: list[Begun] = []
        for i in rows.tolist():
            given = None if episodes is None else episodes[i]
            if given is None:
                begun.append((i, *self._next_episode(i)))
            else:
                if isinstance(given, Mapping):
                    check_entries(given, NUMBERED, "episode")
                    given = numbered(self.scenario, **given)
                begun.append((i, given, None))
        self.senders.load_all(begun)
        self._charges.begin(rows)
        if self.senders.topics:
            self.senders.batch.senders["ask_at_send"][rows] = 1
        return rows

    def _run(self, call: Callable[..., None], rows: NDArray[np.int64], actions: NDArray[np.int64]) -> None:
        call(
            step_rows, self.senders.batch, rows, actions, self.rewarded, self.output, self.choices, self.form.named,
            self.options.repeat, self._charges.cost, self._charges.rival,
        )  # fmt: skip

    def rewards(self) -> NDArray[np.float64]:
        """float64[n]: the weighted sum of the reward terms of the last step, in an array of ``output``."""
        rewards = self.output.rewards
        if self._beside.sums:
            rewards[:] = 0.0
            # Term by term, as the kernels add them: a matrix product may round differently.
            for weight, terms in zip(self.weights, self.output.reward_terms.T, strict=True):
                rewards += weight * terms
        return rewards

    def summary(self, i: Any) -> dict[str, Any]:
        """QoI and message counts so far in sub-environment(s) ``i``, an index or several."""
        senders = self.senders.batch.senders  # indexing it first would copy each sender's whole record
        return {
            "qoi": self.output.qoi[i],
            "arrived": senders["next"][i],
            "delivered": senders["transmitted"][i],
            "dropped": senders["rejected"][i] + senders["evicted"][i],
            "invalid": self.output.invalid[i],
        }

    def info(self, i: int, ended: bool) -> dict[str, Any]:
        """Gymnasium's info of sub-environment ``i`` after a reset or a step; see ``Options.info``."""
        info: dict[str, Any] = {"action_mask": self.output.action_mask[i].copy()}
        if self.choices is not None:
            info["slots"] = self.output.slot_actions[i].copy()
        if not (self._shows_all or ended):
            return info
        if self._shows_all:
            info["qoi"] = self.output.qoi.item(i)
            info["invalid"] = self.output.invalid.item(i)
            info["reward_terms"] = dict(zip(self._term_names, self.output.reward_terms[i].tolist(), strict=True))
        if ended or self._adds_summary:
            info |= {name: number.item() for name, number in self.summary(i).items()}
            if self.options.bound:
                info |= measured(self.senders, i, info["qoi"]) if ended else dict.fromkeys(MEASURED, math.nan)
        return info

    def observation(self, i: int | None = None) -> Observation:
        """The present observation of all, as views of ``output``; of sub-environment ``i`` alone, as a copy."""
        if i is None:
            return self.form.of(self.output.flat)
        row = self.output.flat[i]
        if self._rows is None:
            return row.copy() if self.form.is_row else self.form.of(row)
        numbers, views = self._rows.take()
        numbers[:] = row
        return views.copy()

    def _new_row(self) -> Any:
        """A row of numbers and its views, for a pool: making a dict of twenty views costs more than a step."""
        numbers = np.empty(self.form.numbers, np.float32)
        views = self.form.of(numbers)
        return (numbers, views), [numbers, *views.values()]

    def action(self, name: str, action: Any) -> int:
        """``action`` as an int; the error for a bad action calls it ``name``."""
        try:
            number = operator.index(action)
        except TypeError:
            raise self.bad_action(name, action) from None
        if not 0 <= number < self.actions_count:
            raise self.bad_action(name, number)
        return number

    @property
    def idle_action(self) -> int:
        """The action where no decision is due; it has no effect."""
        return self.capacity if self.choices is None else 0

    def of_slots(self, slots: NDArray[np.int64]) -> NDArray[np.int64]:
        """The actions, int64[n], that mean these actions among slots, int64[n].

        Where no candidate means it, the cheapest candidate, action 0 or at arrivals 1.
        """
        if self.choices is None:
            return slots
        meant = self.output.slot_actions == slots[:, None]
        cheapest = self.actions_count - self.options.candidates - 1
        return np.where(meant.any(axis=1), meant.argmax(axis=1), cheapest)

    def actions(self, actions: Any) -> NDArray[np.int64]:
        """Convert one action for each sub-environment to the kernels' form; the error names the first that is wrong."""
        numbers = np.asarray(actions)
        if numbers.dtype.kind not in "iu":
            raise InvalidActionError(f"actions are {numbers.dtype}: must be whole numbers (int64)")
        numbers = np.ascontiguousarray(numbers, np.int64)
        if numbers.shape != (len(self),):
            raise InvalidActionError(f"actions have shape {numbers.shape}: must be ({len(self)},)")
        unsigned = numbers.view(np.uint64)  # where negative ones are large
        if np.maximum.reduce(unsigned) >= self.actions_count:
            wrong = int(np.argmax(unsigned >= self.actions_count))
            raise self.bad_action(f"actions[{wrong}]", numbers.item(wrong))
        return numbers

    def action_masks(self) -> NDArray[np.bool_]:
        """bool[n, actions]: the actions valid now in each sub-environment."""
        return self.output.action_mask.astype(np.bool_)

    def bounds(self, ended: NDArray[np.bool_], qoi: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Name -> float64[n]: ``measured`` for those that have ``ended`` with this H; 0 elsewhere."""
        columns = {name: np.zeros(len(self)) for name in MEASURED}
        for i in np.flatnonzero(ended).tolist():
            for name, number in measured(self.senders, i, float(qoi[i])).items():
                columns[name][i] = number
        return columns

    def bad_action(self, name: str, action: Any) -> InvalidActionError:
        """Make the error for an action outside of the space."""
        of = f"L = {self.capacity}"
        if self.choices is not None:
            of = f"the {self.options.candidates} cheapest candidates and the head"
        rule = f"must be a whole number in 0..{self.actions_count - 1} ({of})"
        return InvalidActionError(f"{name} = {action!r}: {rule}")

    def _next_episode(self, i: int) -> tuple[Any, np.random.Generator]:
        """The next episode of sub-environment ``i``'s streams, and the generator of its uniform draws."""
        if (streams := self.streams[i]) is None:
            self.seed(i, seeding.np_random()[0])
            return self._next_episode(i)
        return self.scenario.draw(streams), streams.policy
