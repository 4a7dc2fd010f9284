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
from bufgym.errors import BufgymError
from bufgym.kernel import kernel, prefetch
from bufgym.model.buffer import ACCEPT, HOLD, REJECT, UNLIMITED_BYTES
from bufgym.model.link import FOREVER
from bufgym.observe import (
    CONTEXT_FIELDS,
    REWARD_TERMS,
    SLOT_FIELDS,
    TOPIC_CONTEXT_FIELDS,
    TOPIC_REWARD_TERMS,
    TOPIC_SLOT_FIELDS,
    RewardTerm,
    observe_context,
    observe_slots,
    observe_topic_context,
    observe_topic_slots,
)
from bufgym.scenario import Episode, Scenario, Streams
from bufgym.sim import (
    ARRIVAL_WAITS,
    DEPARTURE,
    END,
    SOCKET_WAITS,
    Batch,
    Senders,
    age_until,
    answer_send,
    arrival_of,
    can_evict,
    can_hold,
    can_reject,
    can_send,
    credit,
    decide,
    has_room,
    next_event,
    view,
)

DELIVERED, RETAINED, AGE, LATE = range(len(REWARD_TERMS) + len(TOPIC_REWARD_TERMS))

_AHEAD = 8
"""Rows: far enough for the memory to answer in time, near enough for the answer to be still there."""


class Shown(NamedTuple):
    """What n rows show after a step; rows of these arrays are written by the kernels."""

    slots: NDArray[np.float32]
    """[n, slot fields, L + 1]: those of ``SLOT_FIELDS``, then with several topics those of ``TOPIC_SLOT_FIELDS``."""
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
    event = next_event(batch, None, i)
    while event == DEPARTURE:
        event = next_event(batch, None, i)
    if event == END:
        credit(batch, i, FOREVER)
        # What a dead link never carried was not retained after all.
        sender.retained_gain = sender.delivered_gain
    else:
        credit(batch, i, sender.now_us)
    if sender.topics > 1:
        for topic in range(sender.topics):
            age_until(batch, i, topic, FOREVER if event == END else sender.now_us)


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
    if sender.topics > 1:
        show_topics(batch, i, shown)
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
def show_topics(batch: Batch, i: int, shown: Shown) -> None:
    """The same where there are several topics, and the socket may be who asks."""
    sender = batch.senders[i]
    capacity = sender.capacity
    arriving = sender.waiting == ARRIVAL_WAITS
    # Where the socket asks there is no newcomer; the last arrival stands in and is not read.
    arrival = batch.arrivals[i, min(sender.next, sender.arrivals - 1)]
    buffer = view(batch, i)
    observe_topic_slots(buffer, arrival, arriving, shown.slots[i])
    observe_topic_context(buffer, arrival, arriving, shown.context[i])
    if arriving:
        for k in range(capacity):
            shown.mask[i, k] = can_evict(batch, i, k)
        shown.mask[i, capacity] = can_reject(batch, i)
        shown.mask[i, capacity + 1] = has_room(batch, i)
    else:
        for k in range(capacity):
            shown.mask[i, k] = can_send(batch, i, k)
        shown.mask[i, capacity] = can_hold(batch, i)
        shown.mask[i, capacity + 1] = False


@kernel
def write_rewards(batch: Batch, i: int, rewarded: NDArray[np.float64], shown: Shown) -> None:
    """Write what row ``i`` has earned since it was paid last."""
    sender = batch.senders[i]
    shown.terms[i, DELIVERED] = sender.delivered_gain - rewarded[i, DELIVERED]
    shown.terms[i, RETAINED] = sender.retained_gain - rewarded[i, RETAINED]
    rewarded[i, DELIVERED] = sender.delivered_gain
    rewarded[i, RETAINED] = sender.retained_gain
    if sender.topics > 1:
        weight = 0.0
        for topic in range(sender.topics):
            weight += batch.topics[i, topic].weight
        # Topics that all weigh nothing have paid nothing.
        weight = weight if weight > 0 else 1.0
        shown.terms[i, AGE] = (rewarded[i, AGE] - sender.aged) / weight
        shown.terms[i, LATE] = (rewarded[i, LATE] - sender.late) / weight
        rewarded[i, AGE], rewarded[i, LATE] = sender.aged, sender.late


@kernel
def begin_rows(batch: Batch, rows: NDArray[np.int64], rewarded: NDArray[np.float64], shown: Shown) -> None:
    """Bring freshly loaded rows to their first decision; nothing is paid yet, and ``shown.terms`` stay as they are."""
    for i in rows:
        advance(batch, i)
        rewarded[i, :] = 0.0
        show(batch, i, shown)


@kernel
def step_rows(batch: Batch, actions: NDArray[np.int64], rewarded: NDArray[np.float64], shown: Shown) -> None:
    """One decision in every row. ``rewarded``: float64[n, reward terms], what earlier steps have paid out.

    A row without a decision due (its episode asked for none) just ends.
    """
    for i in range(len(actions)):
        # Every row's messages lie in memory of their own: fetch a later row's next one while this row is worked on.
        later = min(i + _AHEAD, len(actions) - 1)
        soon = min(batch.senders[later].next + 1, batch.arrivals.shape[1] - 1)
        prefetch(batch.arrivals, later, soon)
        prefetch(batch.log, later, soon)
        sender = batch.senders[i]
        if sender.waiting == ARRIVAL_WAITS:
            decide(batch, i, decision_of(actions[i], sender.capacity))
            advance(batch, i)
        elif sender.waiting == SOCKET_WAITS:
            answer_send(batch, i, HOLD if actions[i] == sender.capacity else actions[i])
            advance(batch, i)
        write_rewards(batch, i, rewarded, shown)
        show(batch, i, shown)


def reward_weights(
    reward: str | Mapping[str, float], terms: Sequence[RewardTerm] = REWARD_TERMS
) -> NDArray[np.float64]:
    """float64[reward terms] from one term's name or from weights by name."""
    names = [term.name for term in terms]
    if not isinstance(reward, str | Mapping):
        raise BufgymError(f"reward = {reward!r}: must be the name of a term ({', '.join(names)}) or weights by name")
    given = {reward: 1.0} if isinstance(reward, str) else dict(reward)
    if not given:
        raise BufgymError(f"reward = {reward!r}: give at least one term its weight; known: {', '.join(names)}")
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
        topics = getattr(self.scenario, "topics", ())
        self.senders = Senders(
            n,
            capacity,
            self.scenario.value,
            max_messages=self.scenario.max_messages,
            max_bytes=max_bytes,
            decide_at=decide_at,
            topics=topics,
        )
        self.capacity = self.senders.capacity
        several = bool(topics)
        self.terms = REWARD_TERMS + TOPIC_REWARD_TERMS if several else REWARD_TERMS
        self.weights = reward_weights(reward, self.terms)
        self.slot_fields = SLOT_FIELDS + TOPIC_SLOT_FIELDS if several else SLOT_FIELDS
        self.context_fields = CONTEXT_FIELDS + TOPIC_CONTEXT_FIELDS if several else CONTEXT_FIELDS
        self.asks_at_send = int(several)
        all_fields = self.slot_fields + self.context_fields
        known = [field.name for field in all_fields]
        for name in fields or ():
            if name not in known:
                raise BufgymError(f"fields: unknown field {name!r}; known: {', '.join(known)}")
        chosen = known if fields is None else list(fields)
        if not chosen:
            raise BufgymError("fields: choose at least one field to observe")
        self._slot_keys = [(f.name, i) for i, f in enumerate(self.slot_fields) if f.name in chosen]
        self._context_keys = [(f.name, i) for i, f in enumerate(self.context_fields) if f.name in chosen]
        self.observation_space = spaces.Dict(
            {
                f.name: spaces.Box(f.low, f.high, (self.capacity + 1 if f.per == "slot" else 1,), np.float32)
                for f in all_fields
                if f.name in chosen
            }
        )
        self.action_space = spaces.Discrete(self.capacity + 2)
        self.streams: list[Streams | None] = [None] * n
        self.rewarded = np.zeros((n, len(self.terms)))
        self.shown = self.new_shown()

    def __len__(self) -> int:
        return len(self.senders)

    def new_shown(self) -> Shown:
        """Arrays for what a step shows."""
        n, L = len(self), self.capacity
        return Shown(
            np.zeros((n, len(self.slot_fields), L + 1), np.float32),
            np.zeros((n, len(self.context_fields)), np.float32),
            np.zeros((n, L + 2), np.bool_),
            np.zeros((n, len(self.terms))),
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
        if self.asks_at_send:
            self.senders.batch.senders["ask_at_send"][rows] = 1
        begin_rows(self.senders.batch, rows, self.rewarded, self.shown)

    def step(self, actions: NDArray[np.int64]) -> None:
        """One decision in every row; ``self.shown`` tells what came of it."""
        step_rows(self.senders.batch, actions, self.rewarded, self.shown)

    def summary(self, i: Any) -> dict[str, Any]:
        """What the finished episode(s) of row(s) ``i`` came to: qoi and message counts."""
        sender, topics = self.senders.batch.senders[i], self.senders.batch.topics[i]
        transmitted = sender["transmitted"]
        # The 1 in H = 1 + sum of V, of each topic.
        first = ((topics["received"] > 0) * topics["weight"]).sum(-1) if self.senders.topics else transmitted > 0
        return {
            "qoi": first + sender["delivered_gain"],
            "arrived": sender["next"],
            "delivered": transmitted,
            "dropped": sender["rejected"] + sender["evicted"],
            "invalid": sender["invalid"],
        }

    def observation(self, slots: NDArray[np.float32], context: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        """The Dict observation whose arrays are views of ``slots`` and ``context``, batched or one row."""
        seen = {name: slots[..., f, :] for name, f in self._slot_keys}
        for name, f in self._context_keys:
            seen[name] = context[..., f : f + 1]
        return seen
