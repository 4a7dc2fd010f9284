"""Learned policies: a slot scorer's weights from a file, decided by a compiled forward pass. No torch, no code.

One small network scores every candidate, a queued message or the newcomer. Its inputs are the features of the candidate
and of the context (``model.observe``), so one set of weights serves every L; ``scoring`` has the formula. The *drop*
network scores dropping the candidate. The *accept* network scores accepting the newcomer, where there is room. The
policy takes the decision that scores highest; ties go to the oldest message. Under a byte limit a newcomer that would
take the place of several messages is dropped, unless messages with no lower a score make room.

The context c may also change the weights of the candidate's own features s, by the matrix ``mix`` M: the score of
dropping it grows by c M s. So one agent can weigh a rank or a gap differently where V is straight and where it is flat.

The network decides at every decision. No rule stands beside it: what rules know, such as the link's rate or the mean
motion, is among the fields that it may read.

The file is safetensors with JSON metadata: reading it runs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.kernel import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer, has_space, stays
from bufgym.model.observe import (
    CONTEXT_FIELDS,
    ON_BOARD_FIELDS,
    ON_BOARD_SLOT_FIELDS,
    SLOT_FIELDS,
    observe,
    observe_on_board,
    observe_on_board_slots,
)
from bufgym.policies.registry import Arrival, Memory, Policy
from bufgym.policies.scoring import DROP, KEEP, Network, ScorerWeights, begin, divide, read_context, score, unpack

__all__ = ["NAMES", "Network", "Weights", "policy"]

SLOT_NAMES = tuple(field.name for field in (*SLOT_FIELDS, *ON_BOARD_SLOT_FIELDS))
CONTEXT_NAMES = tuple(field.name for field in (*CONTEXT_FIELDS, *ON_BOARD_FIELDS))
NAMES = SLOT_NAMES + CONTEXT_NAMES
SLOTS, CONTEXT = len(SLOT_NAMES), len(CONTEXT_NAMES)
# Fields beyond these are observed only if they are read.
TABLE_SLOTS, TABLE = len(SLOT_FIELDS), len(CONTEXT_FIELDS)


@kernel
def decide(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """The decision with the highest score."""
    scorer = unpack(buffer.parameters, 2)
    s, L = len(buffer.slots), buffer.capacity
    scratch = divide(memory, scorer, CONTEXT, SLOTS, L)
    observe(buffer, arrival, scratch.rows[:TABLE_SLOTS], scratch.context[:TABLE])
    for i in range(scorer.context):
        if scorer.fields[i] >= TABLE:
            observe_on_board(buffer, arrival, scratch.context[TABLE:])
            break
    for i in range(scorer.context, len(scorer.fields)):
        if scorer.fields[i] >= TABLE_SLOTS:
            observe_on_board_slots(buffer, arrival, scratch.rows[TABLE_SLOTS:])
            break
    read_context(scorer, scratch)
    common = begin(scorer, DROP, scratch)
    own, best, decision, freed_bytes = score(scorer, DROP, common, L, scratch), -np.inf, REJECT, 0
    for k in range(s):
        dropped = score(scorer, DROP, common, k, scratch)
        if dropped >= own:
            freed_bytes += buffer.slots[k].size_bytes
        if dropped > best:
            best, decision = dropped, k
    if not stays(buffer, arrival, own <= best, freed_bytes):
        best, decision = own, REJECT
    if has_space(buffer, arrival):
        common = begin(scorer, KEEP, scratch)
        if score(scorer, KEEP, common, L, scratch) >= best:
            decision = ACCEPT
    return decision


def on_arrival(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """A trained slot scorer."""
    return decide(buffer, arrival, memory)


# --- weights ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Weights(ScorerWeights):
    """A slot scorer for one queue."""

    SLOT_NAMES = SLOT_NAMES
    CONTEXT_NAMES = CONTEXT_NAMES
    NETWORKS = ("drop", "accept")
    LAYERS = 2

    mix: NDArray[np.float32] | None = None
    """[context fields, slot fields], each kind in the order of ``fields``: c M s is added to the score of a drop."""


def policy(name: str, weights: Weights, summary: str = "", source: str = "") -> Policy:
    """Make the policy of these weights; it works for every L."""
    on_link = {field.name for field in (*ON_BOARD_FIELDS, *ON_BOARD_SLOT_FIELDS) if field.group == "link"}
    reads_rate = not on_link.isdisjoint(weights.fields)
    return weights.policy(name, on_arrival, source=source, about=summary, reads_rate=reads_rate)
