"""What a step of any environment does to its senders and what it hands out, as compiled code over arrays.

An environment is n *rows*, each with a sender of its own. ``step_rows`` steps senders that have a link each,
``step_cells`` the robots of cells that share one; what a row observes and is rewarded with is written by the same
kernels for both. The single environment is a batch of one row: row i of a batch and the single environment with row
i's seed run the same code and are equal bit for bit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.errors import BufgymError
from bufgym.kernel import kernel, prefetch
from bufgym.model.buffer import ACCEPT, HOLD, REJECT
from bufgym.model.link import FOREVER
from bufgym.observe import (
    REWARD_TERMS,
    TOPIC_REWARD_TERMS,
    observe_context,
    observe_slots,
    observe_topic_context,
    observe_topic_slots,
)
from bufgym.sim import (
    ARRIVAL_WAITS,
    DECISION,
    DEPARTURE,
    END,
    NOTHING_WAITS,
    SOCKET_WAITS,
    Batch,
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
    offer,
    view,
)
from bufgym.sim.shared_link import Shares, next_in_cell

DELIVERED, RETAINED, AGE, LATE = range(len(REWARD_TERMS) + len(TOPIC_REWARD_TERMS))
"""Columns of ``StepOutput.reward_terms``."""

_AHEAD = 8
"""Rows to prefetch ahead: far enough for memory to answer in time, near enough for the answer to be in cache still."""


class StepOutput(NamedTuple):
    """What a step hands out of n rows; the kernels write these arrays in place.

    Fields:
        slots: float32[n, slot fields, L + 1]: ``SLOT_FIELDS``, then with several topics ``TOPIC_SLOT_FIELDS``.
        context: float32[n, context fields]: ``CONTEXT_FIELDS``, then with several topics ``TOPIC_CONTEXT_FIELDS``.
        action_mask: bool[n, L + 2]: which actions are valid.
        reward_terms: float64[n, reward terms]: what each term adds in this step.
        terminated: bool[n]: the episode is over.
    """

    slots: NDArray[np.float32]
    context: NDArray[np.float32]
    action_mask: NDArray[np.bool_]
    reward_terms: NDArray[np.float64]
    terminated: NDArray[np.bool_]


@kernel
def decision_of(action: int, capacity: int) -> int:
    """The decision that an action stands for: 0..L-1 evict that slot, L reject, L + 1 accept."""
    if action < capacity:
        return action
    return REJECT if action == capacity else ACCEPT


def action_of(decision: int, capacity: int) -> int:
    """The inverse of ``decision_of``; a BufgymError for a number that is no decision."""
    if 0 <= decision < capacity:
        return decision
    if decision in (REJECT, ACCEPT):
        return capacity if decision == REJECT else capacity + 1
    raise BufgymError(f"decision {decision}: must be a slot 0..{capacity - 1}, REJECT or ACCEPT")


# --- what a row hands out --------------------------------------------------------------------------------------------


@kernel
def settle_gains(batch: Batch, i: int, ended: bool) -> None:
    """Bring row ``i``'s delivered QoI and ages up to now; at the end of an episode, up to the last delivery."""
    sender = batch.senders[i]
    until_us = FOREVER if ended else sender.now_us
    credit(batch, i, until_us)
    if ended:
        # Messages that a dead link never carried were not retained after all.
        sender.retained_gain = sender.delivered_gain
    if sender.topics > 1:
        for topic in range(sender.topics):
            age_until(batch, i, topic, until_us)


@kernel
def write_rewards(batch: Batch, i: int, rewarded: NDArray[np.float64], output: StepOutput) -> None:
    """Write what each reward term of row ``i`` has gained since the step before; ``rewarded`` keeps the totals."""
    sender, terms = batch.senders[i], output.reward_terms
    terms[i, DELIVERED] = sender.delivered_gain - rewarded[i, DELIVERED]
    terms[i, RETAINED] = sender.retained_gain - rewarded[i, RETAINED]
    rewarded[i, DELIVERED] = sender.delivered_gain
    rewarded[i, RETAINED] = sender.retained_gain
    if sender.topics > 1:
        weight = 0.0
        for topic in range(sender.topics):
            weight += batch.topics[i, topic].weight
        # Where all topics have weight 0, nothing is rewarded, and any divisor will do.
        weight = weight if weight > 0 else 1.0
        terms[i, AGE] = (rewarded[i, AGE] - sender.aged) / weight
        terms[i, LATE] = (rewarded[i, LATE] - sender.late) / weight
        rewarded[i, AGE], rewarded[i, LATE] = sender.aged, sender.late


@kernel
def write_observation(batch: Batch, i: int, ended: bool, output: StepOutput) -> None:
    """Write row ``i``'s observation and action mask; without a decision due, zeros and L as the one valid action."""
    sender = batch.senders[i]
    output.terminated[i] = ended
    if sender.waiting == NOTHING_WAITS:
        output.slots[i, :, :] = 0.0
        output.context[i, :] = 0.0
        output.action_mask[i, :] = False
        output.action_mask[i, sender.capacity] = True
        return
    buffer = view(batch, i)
    if sender.topics > 1:
        arriving = sender.waiting == ARRIVAL_WAITS
        # When the socket asks there is no newcomer: the last arrival fills the argument and is not read.
        arrival = batch.arrivals[i, min(sender.next, sender.arrivals - 1)]
        observe_topic_slots(buffer, arrival, arriving, output.slots[i])
        observe_topic_context(buffer, arrival, arriving, output.context[i])
    else:
        arrival = arrival_of(batch, i)
        observe_slots(buffer, arrival, output.slots[i])
        observe_context(buffer, arrival, output.context[i])
    write_mask(batch, i, output.action_mask)


@kernel
def write_mask(batch: Batch, i: int, action_mask: NDArray[np.bool_]) -> None:
    """Write which actions are valid for row ``i``, which waits for a decision."""
    sender = batch.senders[i]
    capacity = sender.capacity
    if sender.waiting == SOCKET_WAITS:
        for k in range(capacity):
            action_mask[i, k] = can_send(batch, i, k)
        action_mask[i, capacity] = can_hold(batch, i)
        action_mask[i, capacity + 1] = False
        return
    if sender.topics == 1:
        # The same as below, only faster.
        action_mask[i, : sender.occupancy] = True
        action_mask[i, sender.occupancy : capacity] = False
        action_mask[i, capacity] = True
    else:
        for k in range(capacity):
            action_mask[i, k] = can_evict(batch, i, k)
        action_mask[i, capacity] = can_reject(batch, i)
    action_mask[i, capacity + 1] = has_room(batch, i)


# --- rows with a link each -------------------------------------------------------------------------------------------


@kernel
def advance(batch: Batch, i: int) -> None:
    """Run row ``i`` to its next decision, or to the end of its episode."""
    event = next_event(batch, None, i)
    while event == DEPARTURE:
        event = next_event(batch, None, i)
    settle_gains(batch, i, event == END)


@kernel
def begin_rows(batch: Batch, rows: NDArray[np.int64], rewarded: NDArray[np.float64], output: StepOutput) -> None:
    """Bring freshly loaded rows to their first decision; ``output.reward_terms`` stay as they are."""
    for i in rows:
        advance(batch, i)
        rewarded[i, :] = 0.0
        write_observation(batch, i, batch.senders[i].waiting == NOTHING_WAITS, output)


@kernel
def step_rows(batch: Batch, actions: NDArray[np.int64], rewarded: NDArray[np.float64], output: StepOutput) -> None:
    """One decision in every row. ``rewarded``: float64[n, reward terms], the rewards of the episode so far.

    A row without a decision due (its episode has ended, or asked for none) reports its end.
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
        write_rewards(batch, i, rewarded, output)
        write_observation(batch, i, sender.waiting == NOTHING_WAITS, output)


# --- rows that share the link of a cell ------------------------------------------------------------------------------


@kernel
def advance_cell(batch: Batch, shares: Shares, c: int) -> None:
    """Run cell ``c`` to its next tick with a decision due, or to the end of its episode.

    At a tick every robot has a decision due, but for those whose message is larger than B.
    """
    robots = shares.cells[c].robots
    event = next_event(batch, shares, c)
    while event == DEPARTURE:
        event = next_event(batch, shares, c)
    while event == DECISION and shares.cells[c].robot < robots:
        next_in_cell(batch, shares, c)
    for i in range(c * robots, (c + 1) * robots):
        settle_gains(batch, i, event == END)


@kernel
def decisions_due(batch: Batch, shares: Shares, c: int) -> bool:
    """Whether any robot of cell ``c`` has a decision due: until its episode ends, always between two steps."""
    robots = shares.cells[c].robots
    due = False
    for i in range(c * robots, (c + 1) * robots):
        due = due or batch.senders[i].waiting == ARRIVAL_WAITS
    return due


@kernel
def begin_cells(
    batch: Batch, shares: Shares, cells: NDArray[np.int64], rewarded: NDArray[np.float64], output: StepOutput
) -> None:
    """Bring freshly loaded cells to their first tick; ``output.reward_terms`` stay as they are."""
    for c in cells:
        advance_cell(batch, shares, c)
        robots, ended = shares.cells[c].robots, not decisions_due(batch, shares, c)
        for i in range(c * robots, (c + 1) * robots):
            rewarded[i, :] = 0.0
            write_observation(batch, i, ended, output)


@kernel
def step_cells(
    batch: Batch, shares: Shares, actions: NDArray[np.int64], rewarded: NDArray[np.float64], output: StepOutput
) -> None:
    """One decision of every robot that has one due, as ``step_rows``; cells that have ended stay as they are.

    A cell moves on once none is due: robots that are asked again about the same arrival hold the others up.
    """
    for c in range(len(shares.cells)):
        robots = shares.cells[c].robots
        first = c * robots
        due = decisions_due(batch, shares, c)
        for i in range(first, first + robots):
            if batch.senders[i].waiting == ARRIVAL_WAITS:
                decide(batch, i, decision_of(actions[i], batch.senders[i].capacity))
                if batch.senders[i].waiting == NOTHING_WAITS:
                    offer(batch, shares, i)
        if due and not decisions_due(batch, shares, c):
            advance_cell(batch, shares, c)
        ended = not decisions_due(batch, shares, c)
        for i in range(first, first + robots):
            write_rewards(batch, i, rewarded, output)
            write_observation(batch, i, ended, output)
