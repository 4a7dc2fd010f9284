"""Environments whose actions choose among ordered candidates (``bufgym.model.observe.candidates``).

At a full buffer the k cheapest candidates and the head are k + 1 actions, whatever L is, and all of them are valid. At
every arrival one more comes first: accept where there is room, else drop the cheapest.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.envs.output import StepOutput, write_progress
from bufgym.jit import kernel, unchecked_slice
from bufgym.model.buffer import ACCEPT
from bufgym.model.observe import (
    CANDIDATE_FIELDS,
    QUEUE_FIELDS,
    decision_of_candidate,
    find_candidates,
    is_offered,
    observe_candidates,
)
from bufgym.sim.decisions import has_room
from bufgym.sim.state import NOTHING_WAITS, Batch
from bufgym.sim.view import arrival_of, view

_PER_CANDIDATE, _QUEUE = len(CANDIDATE_FIELDS), len(QUEUE_FIELDS)


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
