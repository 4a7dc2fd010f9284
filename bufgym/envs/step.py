"""The step of every environment: its effect on senders and the arrays it returns, as compiled code.

An environment is n *rows*, each with a sender of its own. ``step_rows`` steps senders that have a link each,
``step_cells`` steps the robots of cells that share one. The same kernels write observations and rewards for both. The
single environment is a batch of one row. Row i of a batch equals the single environment with row i's seed bit for bit,
as both run the same code.
"""

import numpy as np
from numpy.typing import NDArray

from bufgym.envs.cost import Charged, Rival, write_cost, write_paired
from bufgym.envs.output import (
    Choices,
    StepOutput,
    settle_gains,
    write_candidates,
    write_named,
    write_observation,
    write_rewards,
)
from bufgym.jit import kernel, prefetch, unchecked_slice
from bufgym.model.buffer import ACCEPT, HOLD, REJECT
from bufgym.model.observe import Chosen, decision_of_candidate, find_candidates
from bufgym.sim.decisions import answer_send, decide, has_room
from bufgym.sim.shared_link import Shares, next_in_cell
from bufgym.sim.state import ARRIVAL_WAITS, DECISION, DEPARTURE, END, NOTHING_WAITS, SOCKET_WAITS, Batch
from bufgym.sim.transition import next_event, offer
from bufgym.sim.view import arrival_of, view

_AHEAD = 8
"""Rows to prefetch ahead: far enough for memory to answer in time, near enough for the answer to be in cache still."""


@kernel
def advance(batch: Batch, i: int) -> None:
    """Run row ``i`` to its next decision, or to the end of its episode."""
    event = DEPARTURE
    while event == DEPARTURE:
        event = next_event(batch, None, i)
    settle_gains(batch, i, event == END)


@kernel
def candidate_decision(batch: Batch, i: int, action: int, choices: Choices) -> int:
    """The decision that an action of row ``i`` stands for."""
    order = unchecked_slice(choices.order, i, 0, choices.order.shape[1])
    return decision_of_candidate(
        order, batch.senders[i].occupancy, choices.at_arrivals == 1, has_room(batch, i), action
    )


@kernel
def renew_candidates(batch: Batch, i: int, choices: Choices) -> None:
    """Find the candidates of row ``i`` where a decision is due that is not shown."""
    places = choices.order.shape[1]
    order, cost = unchecked_slice(choices.order, i, 0, places), unchecked_slice(choices.cost, i, 0, places)
    find_candidates(view(batch, i), arrival_of(batch, i), order, cost)


@kernel
def decision_of(action: int, capacity: int) -> int:
    """The decision for an action: 0..L-1 evict that slot, L reject, L + 1 accept."""
    if action < capacity:
        return action
    return REJECT if action == capacity else ACCEPT


@kernel
def carry_out(batch: Batch, i: int, action: int, choices: Choices | None) -> None:
    """Carry out the action of row ``i``, whose arrival waits for a decision."""
    if choices is not None:
        decide(batch, i, candidate_decision(batch, i, action, choices))
    else:
        decide(batch, i, decision_of(action, batch.senders[i].capacity))


@kernel
def show(batch: Batch, i: int, ended: bool, output: StepOutput, choices: Choices | None, chosen: Chosen | None) -> None:
    """Write the state of row ``i`` and what it observes: candidates, or else slots as ``write_observation`` does."""
    if choices is not None:
        write_candidates(batch, i, ended, output, choices)
    else:
        write_observation(batch, i, ended, output, chosen)


@kernel
def step_rows(
    batch: Batch,
    rows: NDArray[np.int64],
    actions: NDArray[np.int64],
    rewarded: NDArray[np.float64],
    output: StepOutput,
    choices: Choices | None,
    chosen: Chosen | None,
    repeat: int,
    charged: Charged | None,
    rival: Rival | None,
) -> None:
    """Take ``repeat`` decisions in each of ``rows``; without ``actions``, bring loaded rows to their first decision.

    ``actions`` is int64[n], by row. ``rewarded``, float64[n, reward terms], sums the rewards of the episode so far and
    begins with zeros. A row without a decision due has ended, or asked for none; it reports its end. ``choices`` is
    None where actions are no candidates, ``chosen`` where no built-in fields are named. An action among candidates
    holds for ``repeat`` decisions: its place in their order, which each decision has anew. ``charged`` and
    ``rival`` are the terms of ``bufgym.envs.cost``, or None.
    """
    begins, last = len(actions) == 0, len(rows) - 1
    for r in range(len(rows)):
        # Each row's messages lie in memory of their own: fetch a later row's next one while working on this row.
        prefetch(batch.senders, rows[min(r + 2 * _AHEAD, last)])
        later = rows[min(r + _AHEAD, last)]
        soon = min(batch.senders[later].next + 1, batch.arrivals.shape[1] - 1)
        prefetch(batch.arrivals, later, soon)
        prefetch(batch.log, later, soon)
        i = rows[r]
        sender = batch.senders[i]
        asks = sender.waiting
        if not begins and asks == ARRIVAL_WAITS:
            carry_out(batch, i, actions[i], choices)
        if batch.several is not None and not begins and asks == SOCKET_WAITS:
            answer_send(batch, i, HOLD if actions[i] == sender.capacity else actions[i])
        if begins or asks != NOTHING_WAITS:
            advance(batch, i)
        if choices is not None and not begins:
            for _ in range(1, repeat):
                if sender.waiting == ARRIVAL_WAITS:
                    renew_candidates(batch, i, choices)
                    carry_out(batch, i, actions[i], choices)
                    advance(batch, i)
        write_rewards(batch, i, begins, rewarded, output)
        show(batch, i, sender.waiting == NOTHING_WAITS, output, choices, chosen)
        if charged is not None:
            write_cost(batch, i, begins, charged, output)
        if rival is not None:
            write_paired(batch, i, begins, rival, output)
        if chosen is not None:
            write_named(batch, i, chosen, output.flat)


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


@kernel
def step_cells(
    batch: Batch,
    shares: Shares,
    cells: NDArray[np.int64],
    actions: NDArray[np.int64],
    rewarded: NDArray[np.float64],
    output: StepOutput,
    choices: Choices | None,
    chosen: Chosen | None,
    charged: Charged | None,
) -> None:
    """Take every decision that is due in ``cells``, or bring cells to their first tick, as ``step_rows`` does.

    Cells that have ended stay as they are. A cell moves on once no decision is due: robots asked again about the same
    arrival hold up the others. The ``chosen`` fields come beside the tables.
    """
    begins = len(actions) == 0
    for c in cells:
        robots = shares.cells[c].robots
        first = c * robots
        due = begins or decisions_due(batch, shares, c)
        for i in range(first, first + robots):
            if not begins and batch.senders[i].waiting == ARRIVAL_WAITS:
                carry_out(batch, i, actions[i], choices)
                if batch.senders[i].waiting == NOTHING_WAITS:
                    offer(batch, shares, i)
        if due and (begins or not decisions_due(batch, shares, c)):
            advance_cell(batch, shares, c)
        ended = not decisions_due(batch, shares, c)
        for i in range(first, first + robots):
            write_rewards(batch, i, begins, rewarded, output)
            show(batch, i, ended, output, choices, None)
            if charged is not None:
                write_cost(batch, i, begins, charged, output)
            if chosen is not None:
                write_named(batch, i, chosen, output.flat)
