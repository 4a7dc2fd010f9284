"""Learned scheduling: a slot scorer for several topics, which decides both which message to drop and which to send.

As in ``learned``, one small network scores every candidate from its own features and the context's, here with
``observe.TOPIC_FIELDS`` too. At an arrival the *drop* network scores each message that may be evicted, and the newcomer
if it may be rejected. The *accept* network scores the newcomer if there is room. When the socket is free the *send*
network scores the oldest message of each topic. The policy takes the highest score; ties go to the oldest message. It
never holds the socket back.

One rule is not learned: ``no_drop`` messages go first, as in Robofleet. A ``no_drop`` message is lost only if the queue
holds nothing else, and no better score is worth that risk.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bufgym.ground.kernel import kernel
from bufgym.model.buffer import ACCEPT, HOLD, REJECT, Buffer, is_first
from bufgym.model.observe import (
    CONTEXT_FIELDS,
    SLOT_FIELDS,
    TOPIC_CONTEXT_FIELDS,
    TOPIC_SLOT_FIELDS,
    observe_topic_context,
    observe_topic_slots,
)
from bufgym.policies import scoring
from bufgym.policies.registry import Arrival, Memory, Policy
from bufgym.policies.robofleet import next_no_drop
from bufgym.policies.schedulers import fits, make_room, makes_room
from bufgym.policies.scoring import DROP, KEEP, SEND, Network, Scorer, ScorerWeights, Scratch

SLOTS, CONTEXT = len(SLOT_FIELDS + TOPIC_SLOT_FIELDS), len(CONTEXT_FIELDS + TOPIC_CONTEXT_FIELDS)
NAMES = tuple(field.name for field in SLOT_FIELDS + TOPIC_SLOT_FIELDS + CONTEXT_FIELDS + TOPIC_CONTEXT_FIELDS)


@kernel
def observed(buffer: Buffer, arrival: Arrival, arriving: bool, memory: Memory) -> tuple[Scorer, Scratch]:
    """Unpack the scorer, and write its observation into the memory."""
    scorer = scoring.unpack(buffer.parameters, 3)
    scratch = scoring.divide(memory, scorer, CONTEXT, SLOTS, buffer.capacity)
    observe_topic_context(buffer, arrival, arriving, scratch.context)
    observe_topic_slots(buffer, arrival, arriving, scratch.rows)
    scoring.read_context(scorer, scratch)
    return scorer, scratch


@kernel
def best_drop(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """The decision with the highest score."""
    scorer, scratch = observed(buffer, arrival, True, memory)
    newcomer, no_drop = buffer.capacity, buffer.topics[arrival.topic].no_drop == 1
    common = scoring.begin(scorer, DROP, scratch)
    best, decision = -np.inf, REJECT
    for k in range(len(buffer.slots)):
        if makes_room(buffer, arrival, k):
            dropped = scoring.score(scorer, DROP, common, k, scratch)
            if dropped > best:
                best, decision = dropped, k
    if not no_drop:
        rejected = scoring.score(scorer, DROP, common, newcomer, scratch)
        if rejected > best:
            best, decision = rejected, REJECT
    if fits(buffer, arrival):
        common = scoring.begin(scorer, KEEP, scratch)
        if no_drop or scoring.score(scorer, KEEP, common, newcomer, scratch) >= best:
            decision = ACCEPT
    return decision


@kernel
def best_send(buffer: Buffer, memory: Memory) -> int:
    """The oldest message of the topic with the highest score."""
    scorer, scratch = observed(buffer, buffer.slots[0], False, memory)
    common = scoring.begin(scorer, SEND, scratch)
    best, choice = -np.inf, HOLD
    for k in range(len(buffer.slots)):
        if is_first(buffer, k):
            sent = scoring.score(scorer, SEND, common, k, scratch)
            if sent > best:
                best, choice = sent, k
    return choice


# Kernels return only numbers to Python: the scorer's views stay inside them.


def on_arrival(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """A trained scheduler."""
    if len(buffer.topics) == 1:
        return make_room(buffer, arrival)  # a single queue has no topics to tell apart
    return best_drop(buffer, arrival, memory)


def on_send(buffer: Buffer, memory: Memory) -> int:
    """The oldest no_drop message if there is one, otherwise the message with the highest score."""
    if len(buffer.topics) == 1:
        return 0
    kept = next_no_drop(buffer, 0)
    return kept if kept != HOLD else best_send(buffer, memory)


@dataclass(frozen=True)
class TopicWeights(ScorerWeights):
    """A scheduler's weights: three networks with at most one hidden layer."""

    SLOT_NAMES = NAMES[:SLOTS]
    CONTEXT_NAMES = NAMES[SLOTS:]
    NETWORKS = ("drop", "accept", "send")
    LAYERS = 1

    send: Network
    """Scores sending the oldest message of a topic."""


def policy(name: str, weights: TopicWeights, summary: str = "", source: str = "") -> Policy:
    """Make the policy of these weights; it works for every L and any topics."""
    return weights.policy(name, on_arrival, on_send=on_send, source=source, about=summary, for_topics=True)
