"""What a step returns: the arrays of n rows, and the kernels that write rewards, masks and observations into them."""

import sys
from collections.abc import Callable, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel, unchecked_slice, unchecked_table
from bufgym.model.buffer import ACCEPT
from bufgym.model.link import FOREVER
from bufgym.model.observe import (
    CANDIDATE_FIELDS,
    CONTEXT_FIELDS,
    QUEUE_FIELDS,
    REWARD_TERMS,
    SLOT_FIELDS,
    TOPIC_CONTEXT_FIELDS,
    TOPIC_REWARD_TERMS,
    TOPIC_SLOT_FIELDS,
    Chosen,
    decision_of_candidate,
    find_candidates,
    is_offered,
    observe,
    observe_candidates,
    observe_topic_context,
    observe_topic_slots,
    write_chosen,
    write_chosen_on_board,
)
from bufgym.sim.decisions import can_evict, can_hold, can_reject, can_send, has_room
from bufgym.sim.rules import age_until
from bufgym.sim.socket import credit
from bufgym.sim.state import ARRIVAL_WAITS, NOTHING_WAITS, SOCKET_WAITS, Batch
from bufgym.sim.view import arrival_of, last_arrival, view

DELIVERED, RETAINED, AGE, LATE = range(len(REWARD_TERMS) + len(TOPIC_REWARD_TERMS))
"""Columns of ``StepOutput.reward_terms``."""

_SLOT_FIELDS, _CONTEXT_FIELDS = len(SLOT_FIELDS), len(CONTEXT_FIELDS)
_ALL_SLOT_FIELDS = _SLOT_FIELDS + len(TOPIC_SLOT_FIELDS)
_ALL_CONTEXT_FIELDS = _CONTEXT_FIELDS + len(TOPIC_CONTEXT_FIELDS)
_PER_CANDIDATE, _QUEUE = len(CANDIDATE_FIELDS), len(QUEUE_FIELDS)


class StepOutput(NamedTuple):
    """Results of a step of n rows; the kernels write these arrays in place.

    Fields:
        flat: float32[n, numbers], field by field: first ``SLOT_FIELDS`` (L + 1 numbers each), with several topics also
            ``TOPIC_SLOT_FIELDS``; then ``CONTEXT_FIELDS`` (one number each), likewise with ``TOPIC_CONTEXT_FIELDS``.
            Where actions choose a candidate: ``CANDIDATE_FIELDS`` (k + 1 numbers each), then ``QUEUE_FIELDS``.
        action_mask: int8[n, actions], 1 for a valid action.
        reward_terms: float64[n, reward terms], gain of each term in this step.
        weights: float64[reward terms], read by the kernels.
        rewards: float64[n], sum of the terms times their weights; without terms of your own.
        qoi: float64[n], H of the messages at the server so far.
        invalid: int64[n], invalid actions of the episode so far.
        terminated: bool[n], whether the episode is over.
        slots: int64[1], for several topics: 1 if ``flat`` has the slot fields, 0 if it has the context fields alone.
        slot_actions: int64[n, actions], the action among slots that each action stands for: 0..L-1 evict that slot, L
            rejects, L + 1 accepts. int64[n, 0] where actions are slots.
    """

    flat: NDArray[np.float32]
    action_mask: NDArray[np.int8]
    reward_terms: NDArray[np.float64]
    weights: NDArray[np.float64]
    rewards: NDArray[np.float64]
    qoi: NDArray[np.float64]
    invalid: NDArray[np.int64]
    terminated: NDArray[np.bool_]
    slots: NDArray[np.int64]
    slot_actions: NDArray[np.int64]


class Choices(NamedTuple):
    """The candidates of n rows; the kernels write these arrays in place.

    Fields:
        order: int64[n, k + 1], slots of the k cheapest candidates and the head, as ``find_candidates`` writes them.
        cost: float64[n, k + 1], their merged gaps.
        at_arrivals: 1 if every arrival asks, and action 0 accepts where there is room.
    """

    order: NDArray[np.int64]
    cost: NDArray[np.float64]
    at_arrivals: int


def new_choices(n: int, candidates: int, at_arrivals: bool) -> Choices:
    """Room for ``candidates`` and the head in each of n rows."""
    shape = n, candidates + 1
    return Choices(np.zeros(shape, np.int64), np.zeros(shape), int(at_arrivals))


@kernel
def settle_gains(batch: Batch, i: int, ended: bool) -> None:
    """Bring row ``i``'s delivered QoI and ages up to now, or at an episode's end up to the last delivery."""
    sender = batch.senders[i]
    until_us = FOREVER if ended else sender.now_us
    credit(batch, i, until_us)
    if ended:
        # Messages that a dead link never carried were not retained after all.
        sender.retained_gain = sender.delivered_gain
    if batch.several is not None:
        age_until(batch, i, until_us)


@kernel
def write_rewards(batch: Batch, i: int, begins: bool, rewarded: NDArray[np.float64], output: StepOutput) -> None:
    """Write the gain of each reward term of row ``i`` since the step before; ``rewarded`` keeps the totals.

    An episode that ``begins`` has gained nothing.
    """
    sender, terms = batch.senders[i], output.reward_terms
    output.rewards[i] = 0.0
    if begins:
        rewarded[i, :] = 0.0
        terms[i, :] = 0.0
        return
    terms[i, DELIVERED] = sender.delivered_gain - rewarded[i, DELIVERED]
    terms[i, RETAINED] = sender.retained_gain - rewarded[i, RETAINED]
    rewarded[i, DELIVERED] = sender.delivered_gain
    rewarded[i, RETAINED] = sender.retained_gain
    if batch.several is not None:
        terms[i, AGE] = (rewarded[i, AGE] - sender.aged) / sender.weight
        terms[i, LATE] = (rewarded[i, LATE] - sender.late) / sender.weight
        rewarded[i, AGE], rewarded[i, LATE] = sender.aged, sender.late
    add_rewards(output, i)


@kernel
def add_rewards(output: StepOutput, i: int) -> None:
    """Add the weighted terms of row ``i`` up."""
    output.rewards[i] = 0.0
    for k in range(len(output.weights)):
        output.rewards[i] += output.weights[k] * output.reward_terms[i, k]


@kernel
def delivered_qoi(batch: Batch, i: int) -> float:
    """H of the messages that have reached row ``i``'s server so far."""
    sender = batch.senders[i]
    # The 1 in H = 1 + sum of V, for each topic with a delivery.
    ones = 1.0 if sender.credited > 0 else 0.0
    if batch.several is not None:
        ones = sender.heard
    return float(ones + sender.delivered_gain)


@kernel
def write_progress(batch: Batch, i: int, ended: bool, output: StepOutput) -> None:
    """Write whether row ``i`` has ended, its H, and its invalid actions so far."""
    output.terminated[i] = ended
    output.qoi[i], output.invalid[i] = delivered_qoi(batch, i), batch.senders[i].invalid


@kernel
def write_observation(batch: Batch, i: int, ended: bool, output: StepOutput, chosen: Chosen | None) -> None:
    """Write whether row ``i`` has ended, its H, its action mask and the fields of its tables.

    With one queue the fields only if none are ``chosen``. Without a decision due, the observation is zeros, and L is
    the one valid action.
    """
    write_progress(batch, i, ended, output)
    sender = batch.senders[i]
    if sender.waiting == NOTHING_WAITS:
        output.flat[i, :] = 0.0
        output.action_mask[i, :] = False
        output.action_mask[i, sender.capacity] = True
        return
    write_mask(batch, i, output.action_mask)
    buffer, entries = view(batch, i), sender.capacity + 1
    if batch.several is not None:
        entries *= output.slots[0]
        arriving = sender.waiting == ARRIVAL_WAITS
        # When the socket asks there is no newcomer: the last arrival fills the argument and is not read.
        arrival = batch.arrivals[i, min(sender.next, sender.arrivals - 1)]
        first = _ALL_SLOT_FIELDS * entries
        if entries > 0:
            observe_topic_slots(buffer, arrival, arriving, unchecked_table(output.flat[i], _ALL_SLOT_FIELDS, entries))
        observe_topic_context(buffer, arrival, arriving, unchecked_slice(output.flat, i, first, _ALL_CONTEXT_FIELDS))
    elif chosen is None:
        arrival = arrival_of(batch, i)
        first = _SLOT_FIELDS * entries
        rows, context = (
            unchecked_table(output.flat[i], _SLOT_FIELDS, entries),
            unchecked_slice(output.flat, i, first, _CONTEXT_FIELDS),
        )
        observe(buffer, arrival, rows, context)


@kernel
def write_named(batch: Batch, i: int, chosen: Chosen, flat: NDArray[np.float32]) -> None:
    """Write the fields that row ``i`` observes because they are named, if it waits for a decision."""
    waiting = batch.senders[i].waiting
    if waiting == NOTHING_WAITS:
        return
    buffer, row = view(batch, i), unchecked_slice(flat, i, 0, flat.shape[1])
    if batch.several is None:
        write_chosen(buffer, arrival_of(batch, i), chosen, row)
    else:
        write_chosen_on_board(buffer, last_arrival(batch, i), waiting == ARRIVAL_WAITS, chosen, row)


@kernel
def write_mask(batch: Batch, i: int, action_mask: NDArray[np.int8]) -> None:
    """Write the valid actions of row ``i``, which waits for a decision."""
    sender = batch.senders[i]
    capacity = sender.capacity
    action_mask[i, sender.occupancy : capacity] = False
    if batch.several is None:
        # The same as below, only faster.
        action_mask[i, : sender.occupancy] = True
        action_mask[i, capacity] = True
    else:
        if sender.waiting == SOCKET_WAITS:
            for k in range(sender.occupancy):
                action_mask[i, k] = can_send(batch, i, k)
            action_mask[i, capacity] = can_hold(batch, i)
            action_mask[i, capacity + 1] = False
            return
        for k in range(sender.occupancy):
            action_mask[i, k] = can_evict(batch, i, k)
        action_mask[i, capacity] = can_reject(batch, i)
    action_mask[i, capacity + 1] = has_room(batch, i)


@kernel
def write_candidates(batch: Batch, i: int, ended: bool, output: StepOutput, choices: Choices) -> None:
    """Write row ``i``'s state, candidates, action mask and observation.

    The mask marks the actions that are offered. Without a decision due action 0 alone is marked, and the observation is
    zeros.
    """
    write_progress(batch, i, ended, output)
    sender = batch.senders[i]
    places, mask = choices.order.shape[1], output.action_mask
    actions, capacity = mask.shape[1], sender.capacity
    if sender.waiting == NOTHING_WAITS:
        output.flat[i, :] = 0.0
        mask[i, :], output.slot_actions[i, :] = 0, capacity
        mask[i, 0] = 1
        return
    buffer, arrival = view(batch, i), arrival_of(batch, i)
    order, cost = unchecked_slice(choices.order, i, 0, places), unchecked_slice(choices.cost, i, 0, places)
    find_candidates(buffer, arrival, order, cost)
    observe_candidates(
        buffer, arrival, order, cost, unchecked_slice(output.flat, i, 0, _PER_CANDIDATE * places + _QUEUE)
    )
    room, at_arrivals = has_room(batch, i), choices.at_arrivals == 1
    for action in range(actions):
        decision = decision_of_candidate(order, sender.occupancy, at_arrivals, room, action)
        slot = decision
        if decision < 0:
            slot = capacity + 1 if decision == ACCEPT else capacity
        output.slot_actions[i, action] = slot
        mask[i, action] = is_offered(order, at_arrivals, room, action)


Buffers = TypeVar("Buffers")


class BufferPool(Generic[Buffers]):
    """Arrays for results, used again once the caller has let go of them, so that a step allocates nothing.

    Python counts the references to an array. As long as there are more to one of the arrays, or to a view of it, than
    when it was made, the caller holds it, and it is not written again. Without the pool a step of 64 environments takes
    50 us in place of 36 with candidates, and 88 in place of 42 with slots. One environment with slots takes 14 us in
    place of 5.4; with candidates its 27 numbers are copied, which takes no pool.
    """

    def __init__(self, make: Callable[[], tuple[Buffers, Sequence[NDArray[Any]]]]) -> None:
        """``make`` returns new buffers, and their arrays with all views of them that are returned."""
        self._make = make
        self._pool: list[tuple[Buffers, Sequence[NDArray[Any]], list[int]]] = []

    def take(self) -> Buffers:
        """Buffers that nobody holds, with any content."""
        for buffers, arrays, references_when_free in self._pool:
            if list(map(sys.getrefcount, arrays)) == references_when_free:
                return buffers
        buffers, arrays = self._make()
        # The oldest leave the pool, as a caller that collects results holds them all.
        self._pool = [*self._pool[1 - _POOLED :], (buffers, arrays, list(map(sys.getrefcount, arrays)))]
        return buffers


_POOLED = 4  # Most buffers in a pool
