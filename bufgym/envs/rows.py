"""The rows that both environments are made of: n senders, what they show, and one compiled step over all of them.

The single environment is a batch of one row, the vector environment one of n; row i of the batch and the single
environment with row i's seed go through the same code and are equal bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, cast

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from numpy.typing import NDArray

from bufgym import scenario as scenarios
from bufgym.buffer import ACCEPT, REJECT, UNLIMITED_BYTES
from bufgym.errors import BufgymError
from bufgym.kernel import kernel, prefetch
from bufgym.link import FOREVER
from bufgym.observe import CONTEXT_FIELDS, FIELDS, REWARD_TERMS, SLOT_FIELDS, observe_context, observe_slots
from bufgym.scenario import Episode, Scenario, Streams
from bufgym.sender import (
    DECISION,
    DEPARTURE,
    Batch,
    Senders,
    arrival_of,
    can_evict,
    credit,
    decide,
    has_room,
    next_event,
    view,
)

DELIVERED, RETAINED = range(len(REWARD_TERMS))

_AHEAD = 8
"""Rows: far enough for the memory to answer in time, near enough for the answer to be still there."""


class Shown(NamedTuple):
    """What n rows show after a step; rows of these arrays are written by the kernels."""

    slots: NDArray[np.float32]
    """[n, slot fields, L + 1]"""
    context: NDArray[np.float32]
    """[n, context fields]"""
    mask: NDArray[np.bool_]
    """[n, L + 2]: which actions are possible."""
    terms: NDArray[np.float64]
    """[n, reward terms]: earned since the step before."""
    ended: NDArray[np.bool_]
    """[n]: the episode is over."""


@kernel
def decision_of(action: int, capacity: int) -> int:
    """Actions are slots 0..L-1 to evict, L to reject, L + 1 to accept."""
    if action < capacity:
        return action
    return REJECT if action == capacity else ACCEPT


def action_of(decision: int, capacity: int) -> int:
    """The inverse of ``decision_of``; a BufgymError for what is no decision."""
    if 0 <= decision < capacity:
        return decision
    if decision in (REJECT, ACCEPT):
        return capacity if decision == REJECT else capacity + 1
    raise BufgymError(f"decision {decision}: must be a slot 0..{capacity - 1}, REJECT or ACCEPT")


@kernel
def advance(batch: Batch, i: int) -> None:
    """On to the next decision, or to the end and all information counted."""
    sender = batch.senders[i]
    event = next_event(batch, i)
    while event == DEPARTURE:
        event = next_event(batch, i)
    if event == DECISION:
        credit(batch, i, sender.now_us)
    else:
        credit(batch, i, FOREVER)
        # What a dead link never carried was not retained after all.
        sender.retained_gain = sender.delivered_gain


@kernel
def show(batch: Batch, i: int, shown: Shown) -> None:
    """Write row ``i``'s observation and mask."""
    sender = batch.senders[i]
    capacity = sender.capacity
    shown.ended[i] = sender.waiting == 0
    if sender.waiting == 0:
        shown.slots[i, :, :] = 0.0
        shown.context[i, :] = 0.0
        shown.mask[i, :] = False
        shown.mask[i, capacity] = True
        return
    buffer, arrival = view(batch, i), arrival_of(batch, i)
    observe_slots(buffer, arrival, shown.slots[i])
    observe_context(buffer, arrival, shown.context[i])
    if sender.max_bytes < UNLIMITED_BYTES:
        for k in range(capacity):
            shown.mask[i, k] = can_evict(batch, i, k)
    else:
        shown.mask[i, : sender.occupancy] = True
        shown.mask[i, sender.occupancy : capacity] = False
    shown.mask[i, capacity] = True
    shown.mask[i, capacity + 1] = has_room(batch, i)


@kernel
def begin_rows(batch: Batch, rows: NDArray[np.int64], paid: NDArray[np.float64], shown: Shown) -> None:
    """Bring freshly loaded rows to their first decision; nothing is paid yet, and ``shown.terms`` stay as they are."""
    for i in rows:
        advance(batch, i)
        paid[i, :] = 0.0
        show(batch, i, shown)


@kernel
def step_rows(batch: Batch, actions: NDArray[np.int64], paid: NDArray[np.float64], shown: Shown) -> None:
    """One decision in every row. ``paid``: float64[n, reward terms], what earlier steps have paid out.

    A row without a decision due (its episode asked for none) just ends.
    """
    for i in range(len(actions)):
        # Every row's messages lie in memory of their own: fetch a later row's next one while this row is worked on.
        later = min(i + _AHEAD, len(actions) - 1)
        soon = min(batch.senders[later].next + 1, batch.arrivals.shape[1] - 1)
        prefetch(batch.arrivals, later, soon)
        prefetch(batch.fates, later, soon)
        sender = batch.senders[i]
        if sender.waiting == 1:
            decide(batch, i, decision_of(actions[i], sender.capacity))
            advance(batch, i)
        shown.terms[i, DELIVERED] = sender.delivered_gain - paid[i, DELIVERED]
        shown.terms[i, RETAINED] = sender.retained_gain - paid[i, RETAINED]
        paid[i, DELIVERED] = sender.delivered_gain
        paid[i, RETAINED] = sender.retained_gain
        show(batch, i, shown)


def reward_weights(reward: str | Mapping[str, float]) -> NDArray[np.float64]:
    """float64[reward terms] from one term's name or from weights by name."""
    names = [term.name for term in REWARD_TERMS]
    if not isinstance(reward, str | Mapping):
        raise BufgymError(f"reward = {reward!r}: must be the name of a term ({', '.join(names)}) or weights by name")
    given = {reward: 1.0} if isinstance(reward, str) else dict(reward)
    for name, weight in given.items():
        if name not in names:
            raise BufgymError(f"reward = {reward!r}: unknown term {name!r}; known: {', '.join(names)}")
        if not np.isfinite(weight):
            raise BufgymError(f"reward = {reward!r}: the weight of {name!r} must be a finite number")
    return np.array([given.get(name, 0.0) for name in names], np.float64)


class Rows:
    """n senders with their streams of chance, stepped together."""

    def __init__(
        self,
        n: int,
        *,
        scenario: str | Scenario,
        capacity: int,
        max_bytes: int | None,
        decide_at: str,
        reward: str | Mapping[str, float],
        fields: Sequence[str] | None,
        parameters: Mapping[str, Any],
    ) -> None:
        self.scenario = scenarios.get(scenario, **parameters)
        self.senders = Senders(
            n,
            capacity,
            self.scenario.value,
            max_messages=self.scenario.max_messages,
            max_bytes=max_bytes,
            decide_at=decide_at,
        )
        self.capacity = self.senders.capacity
        self.weights = reward_weights(reward)
        known = [field.name for field in FIELDS]
        for name in fields or ():
            if name not in known:
                raise BufgymError(f"fields: unknown field {name!r}; known: {', '.join(known)}")
        chosen = known if fields is None else list(fields)
        if not chosen:
            raise BufgymError("fields: choose at least one field to observe")
        self._slot_keys = [(f.name, i) for i, f in enumerate(SLOT_FIELDS) if f.name in chosen]
        self._context_keys = [(f.name, i) for i, f in enumerate(CONTEXT_FIELDS) if f.name in chosen]
        self.observation_space = spaces.Dict(
            {
                f.name: spaces.Box(f.low, f.high, (self.capacity + 1 if f.per == "slot" else 1,), np.float32)
                for f in FIELDS
                if f.name in chosen
            }
        )
        self.action_space = spaces.Discrete(self.capacity + 2)
        self.streams: list[Streams | None] = [None] * n
        self.paid = np.zeros((n, len(REWARD_TERMS)))
        self.shown = self.new_shown()

    def __len__(self) -> int:
        return len(self.senders)

    def new_shown(self) -> Shown:
        """Arrays for what a step shows."""
        n, L = len(self), self.capacity
        return Shown(
            np.zeros((n, len(SLOT_FIELDS), L + 1), np.float32),
            np.zeros((n, len(CONTEXT_FIELDS)), np.float32),
            np.zeros((n, L + 2), np.bool_),
            np.zeros((n, len(REWARD_TERMS))),
            np.zeros(n, np.bool_),
        )

    def seed(self, i: int, rng: np.random.Generator) -> None:
        """Give row ``i`` streams of its own, derived from the generator that Gymnasium seeded."""
        self.streams[i] = Streams.seeded(int(rng.integers(2**63)))

    def reset(self, rows: NDArray[np.int64], episodes: Sequence[Episode | None] | None = None) -> None:
        """Begin a new episode in each of ``rows`` and show it: the given one (by row), or the next of its streams."""
        draw, load = self.scenario.draw, self.senders.load
        for i in rows.tolist():
            episode = episodes[i] if episodes is not None else None
            if episode is None:
                if self.streams[i] is None:
                    self.seed(i, seeding.np_random()[0])
                episode = draw(cast(Streams, self.streams[i]))
            load(i, episode)
        begin_rows(self.senders.batch, rows, self.paid, self.shown)

    def step(self, actions: NDArray[np.int64]) -> None:
        """One decision in every row; ``self.shown`` tells what came of it."""
        step_rows(self.senders.batch, actions, self.paid, self.shown)

    def summary(self, i: Any) -> dict[str, Any]:
        """What the finished episode(s) of row(s) ``i`` came to: qoi and message counts."""
        sender = self.senders.batch.senders[i]
        crossed = sender["crossed"]
        return {
            "qoi": (crossed > 0) + sender["delivered_gain"],
            "arrived": sender["next"],
            "delivered": crossed,
            "dropped": sender["rejected"] + sender["evicted"],
            "impossible": sender["impossible"],
        }

    def observation(self, slots: NDArray[np.float32], context: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        """The Dict observation whose arrays are views of ``slots`` and ``context``, batched or one row."""
        seen = {name: slots[..., f, :] for name, f in self._slot_keys}
        for name, f in self._context_keys:
            seen[name] = context[..., f : f + 1]
        return seen
