"""What a step returns: the arrays of n rows, and the kernels that write rewards, masks and observations into them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel, unchecked_slice, unchecked_table
from bufgym.model.buffer import ACCEPT, REJECT
from bufgym.model.link import FOREVER
from bufgym.model.observe import (
    CONTEXT_FIELDS,
    REWARD_TERMS,
    SLOT_FIELDS,
    TOPIC_CONTEXT_FIELDS,
    TOPIC_REWARD_TERMS,
    TOPIC_SLOT_FIELDS,
    Chosen,
    observe,
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
def decision_of(action: int, capacity: int) -> int:
    """The decision for an action: 0..L-1 evict that slot, L reject, L + 1 accept."""
    if action < capacity:
        return action
    return REJECT if action == capacity else ACCEPT
