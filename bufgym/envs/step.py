"""The step of every environment: its effect on senders and the arrays it hands out, as compiled code.

An environment is n *rows*, each with a sender of its own. ``step_rows`` steps senders that have a link each,
``step_cells`` steps the robots of cells that share one. The same kernels write observations and rewards for both. The
single environment is a batch of one row. Row i of a batch equals the single environment with row i's seed bit for bit,
as both run the same code.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.kernel import direct, kernel, prefetch, stretch, table
from bufgym.model.buffer import ACCEPT, HOLD, REJECT
from bufgym.model.link import FOREVER
from bufgym.model.observe import (
    CONTEXT_FIELDS,
    REWARD_TERMS,
    SLOT_FIELDS,
    TOPIC_CONTEXT_FIELDS,
    TOPIC_REWARD_TERMS,
    TOPIC_SLOT_FIELDS,
    observe,
    observe_topic_context,
    observe_topic_slots,
)
from bufgym.sim.decisions import answer_send, can_evict, can_hold, can_reject, can_send, decide, has_room
from bufgym.sim.rules import age_until
from bufgym.sim.shared_link import Shares, next_in_cell
from bufgym.sim.socket import credit
from bufgym.sim.state import ARRIVAL_WAITS, DECISION, DEPARTURE, END, NOTHING_WAITS, SOCKET_WAITS, Batch
from bufgym.sim.transition import next_event, offer
from bufgym.sim.view import arrival_of, view

DELIVERED, RETAINED, AGE, LATE = range(len(REWARD_TERMS) + len(TOPIC_REWARD_TERMS))
"""Columns of ``StepOutput.reward_terms``."""

_SLOT_FIELDS, _CONTEXT_FIELDS = len(SLOT_FIELDS), len(CONTEXT_FIELDS)
_ALL_SLOT_FIELDS, _ALL_CONTEXT_FIELDS = (
    _SLOT_FIELDS + len(TOPIC_SLOT_FIELDS),
    _CONTEXT_FIELDS + len(TOPIC_CONTEXT_FIELDS),
)

_AHEAD = 8
"""Rows to prefetch ahead: far enough for memory to answer in time, near enough for the answer to be in cache still."""


class StepOutput(NamedTuple):
    """Results of a step of n rows; the kernels write these arrays in place.

    Fields:
        flat: float32[n, numbers], field by field: first ``SLOT_FIELDS`` (L + 1 numbers each), with several topics also
            ``TOPIC_SLOT_FIELDS``; then ``CONTEXT_FIELDS`` (one number each), likewise with ``TOPIC_CONTEXT_FIELDS``.
        action_mask: int8[n, L + 2], 1 for a valid action.
        reward_terms: float64[n, reward terms], gain of each term in this step.
        qoi: float64[n], H of the messages at the server so far.
        invalid: int64[n], invalid actions of the episode so far.
        terminated: bool[n], whether the episode is over.
        slots: int64[1], 1 if ``flat`` has the slot fields, 0 if it has the context fields alone.
    """

    flat: NDArray[np.float32]
    action_mask: NDArray[np.int8]
    reward_terms: NDArray[np.float64]
    qoi: NDArray[np.float64]
    invalid: NDArray[np.int64]
    terminated: NDArray[np.bool_]
    slots: NDArray[np.int64]


@kernel
def decision_of(action: int, capacity: int) -> int:
    """The decision for an action: 0..L-1 evict that slot, L reject, L + 1 accept."""
    if action < capacity:
        return action
    return REJECT if action == capacity else ACCEPT


# --- what a row hands out --------------------------------------------------------------------------------------------


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
        for topic in range(sender.topics):
            age_until(batch, i, topic, until_us)


@kernel
def write_rewards(batch: Batch, i: int, begins: bool, rewarded: NDArray[np.float64], output: StepOutput) -> None:
    """Write the gain of each reward term of row ``i`` since the step before; ``rewarded`` keeps the totals.

    An episode that ``begins`` has gained nothing.
    """
    sender, terms = batch.senders[i], output.reward_terms
    if begins:
        rewarded[i, :] = 0.0
        terms[i, :] = 0.0
        return
    terms[i, DELIVERED] = sender.delivered_gain - rewarded[i, DELIVERED]
    terms[i, RETAINED] = sender.retained_gain - rewarded[i, RETAINED]
    rewarded[i, DELIVERED] = sender.delivered_gain
    rewarded[i, RETAINED] = sender.retained_gain
    if batch.several is not None:
        weight = 0.0
        for topic in range(sender.topics):
            weight += batch.topics[i, topic].weight
        # If all topics have weight 0, nothing is rewarded, and any divisor will do.
        weight = weight if weight > 0 else 1.0
        terms[i, AGE] = (rewarded[i, AGE] - sender.aged) / weight
        terms[i, LATE] = (rewarded[i, LATE] - sender.late) / weight
        rewarded[i, AGE], rewarded[i, LATE] = sender.aged, sender.late


@kernel
def delivered_qoi(batch: Batch, i: int) -> float:
    """H of the messages that have reached row ``i``'s server so far."""
    sender = batch.senders[i]
    # The 1 in H = 1 + sum of V, for each topic with a delivery.
    ones = 1.0 if sender.credited > 0 else 0.0
    if batch.several is not None:
        ones = 0.0
        for topic in range(sender.topics):
            if batch.topics[i, topic].received > 0:
                ones += batch.topics[i, topic].weight
    return float(ones + sender.delivered_gain)


@kernel
def write_state(batch: Batch, i: int, ended: bool, output: StepOutput) -> bool:
    """Write whether row ``i`` has ended, its H and action mask; return whether a decision is due.

    Without one, also write an observation of zeros, with L as the one valid action.
    """
    output.terminated[i] = ended
    output.qoi[i], output.invalid[i] = delivered_qoi(batch, i), batch.senders[i].invalid
    if batch.senders[i].waiting == NOTHING_WAITS:
        output.flat[i, :] = 0.0
        output.action_mask[i, :] = False
        output.action_mask[i, batch.senders[i].capacity] = True
        return False
    write_mask(batch, i, output.action_mask)
    return True


@kernel
def write_observation(batch: Batch, i: int, ended: bool, output: StepOutput) -> None:
    """Write row ``i``'s state and the observation of its tables' fields."""
    if not write_state(batch, i, ended, output):
        return
    sender = batch.senders[i]
    buffer, entries = view(batch, i), (sender.capacity + 1) * output.slots[0]
    if batch.several is not None:
        arriving = sender.waiting == ARRIVAL_WAITS
        # When the socket asks there is no newcomer: the last arrival fills the argument and is not read.
        arrival = batch.arrivals[i, min(sender.next, sender.arrivals - 1)]
        first = _ALL_SLOT_FIELDS * entries
        if entries > 0:
            observe_topic_slots(buffer, arrival, arriving, table(output.flat, i, 0, _ALL_SLOT_FIELDS, entries))
        observe_topic_context(buffer, arrival, arriving, stretch(output.flat, i, first, _ALL_CONTEXT_FIELDS))
    else:
        arrival = arrival_of(batch, i)
        first = _SLOT_FIELDS * entries
        rows, context = table(output.flat, i, 0, _SLOT_FIELDS, entries), stretch(output.flat, i, first, _CONTEXT_FIELDS)
        observe(buffer, arrival, rows, context)


@kernel
def write_mask(batch: Batch, i: int, action_mask: NDArray[np.int8]) -> None:
    """Write the valid actions of row ``i``, which waits for a decision."""
    sender = batch.senders[i]
    capacity = sender.capacity
    if batch.several is None:
        # The same as below, only faster.
        action_mask[i, : sender.occupancy] = True
        action_mask[i, sender.occupancy : capacity] = False
        action_mask[i, capacity] = True
    else:
        if sender.waiting == SOCKET_WAITS:
            for k in range(capacity):
                action_mask[i, k] = can_send(batch, i, k)
            action_mask[i, capacity] = can_hold(batch, i)
            action_mask[i, capacity + 1] = False
            return
        for k in range(capacity):
            action_mask[i, k] = can_evict(batch, i, k)
        action_mask[i, capacity] = can_reject(batch, i)
    action_mask[i, capacity + 1] = has_room(batch, i)


# --- rows with a link each -------------------------------------------------------------------------------------------


@kernel
def advance(batch: Batch, i: int) -> None:
    """Run row ``i`` to its next decision, or to the end of its episode."""
    event = DEPARTURE
    while event == DEPARTURE:
        event = next_event(batch, None, i)
    settle_gains(batch, i, event == END)


@direct
@kernel
def step_rows(
    batch: Batch,
    rows: NDArray[np.int64],
    actions: NDArray[np.int64],
    rewarded: NDArray[np.float64],
    output: StepOutput,
) -> None:
    """Take one decision in each of ``rows``; without ``actions``, bring freshly loaded rows to their first decision.

    ``actions`` is int64[n], by row. ``rewarded``, float64[n, reward terms], sums the rewards of the episode so far and
    begins with zeros. A row without a decision due has ended, or asked for none; it reports its end.
    """
    begins, last = len(actions) == 0, len(rows) - 1
    for r in range(len(rows)):
        # Each row's messages lie in memory of their own: fetch a later row's next one while working on this row.
        later = rows[min(r + _AHEAD, last)]
        soon = min(batch.senders[later].next + 1, batch.arrivals.shape[1] - 1)
        prefetch(batch.arrivals, later, soon)
        prefetch(batch.log, later, soon)
        i = rows[r]
        sender = batch.senders[i]
        asks = sender.waiting
        if not begins and asks == ARRIVAL_WAITS:
            decide(batch, i, decision_of(actions[i], sender.capacity))
        if batch.several is not None and not begins and asks == SOCKET_WAITS:
            answer_send(batch, i, HOLD if actions[i] == sender.capacity else actions[i])
        if begins or asks != NOTHING_WAITS:
            advance(batch, i)
        write_rewards(batch, i, begins, rewarded, output)
        write_observation(batch, i, sender.waiting == NOTHING_WAITS, output)


# --- rows that share the link of a cell ------------------------------------------------------------------------------


@kernel
def advance_cell(batch: Batch, shares: Shares, c: int) -> None:
    """Run cell ``c`` to its next tick with a decision due, or to the end of its episode.

    At a tick every robot has a decision due, except robots whose message is larger than B.
    """
    robots = shares.cells[c].robots
    event = DEPARTURE
    while event == DEPARTURE:
        event = next_event(batch, shares, c)
    while event == DECISION and shares.cells[c].robot < robots:
        next_in_cell(batch, shares, c)
    for i in range(c * robots, (c + 1) * robots):
        settle_gains(batch, i, event == END)


@kernel
def decisions_due(batch: Batch, shares: Shares, c: int) -> bool:
    """Whether any robot of cell ``c`` has a decision due. Between two steps of an episode this is always so."""
    robots = shares.cells[c].robots
    due = False
    for i in range(c * robots, (c + 1) * robots):
        due = due or batch.senders[i].waiting == ARRIVAL_WAITS
    return due


@direct
@kernel
def step_cells(
    batch: Batch,
    shares: Shares,
    cells: NDArray[np.int64],
    actions: NDArray[np.int64],
    rewarded: NDArray[np.float64],
    output: StepOutput,
) -> None:
    """Take every decision that is due in ``cells``, or bring cells to their first tick, as ``step_rows`` does.

    Cells that have ended stay as they are. A cell moves on once no decision is due: robots asked again about the same
    arrival hold up the others.
    """
    begins = len(actions) == 0
    for c in cells:
        robots = shares.cells[c].robots
        first = c * robots
        due = begins or decisions_due(batch, shares, c)
        for i in range(first, first + robots):
            if not begins and batch.senders[i].waiting == ARRIVAL_WAITS:
                decide(batch, i, decision_of(actions[i], batch.senders[i].capacity))
                if batch.senders[i].waiting == NOTHING_WAITS:
                    offer(batch, shares, i)
        if due and (begins or not decisions_due(batch, shares, c)):
            advance_cell(batch, shares, c)
        ended = not decisions_due(batch, shares, c)
        for i in range(first, first + robots):
            write_rewards(batch, i, begins, rewarded, output)
            write_observation(batch, i, ended, output)
