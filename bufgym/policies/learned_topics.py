"""Learned scheduling: a slot scorer for several topics, which decides both what is dropped and what goes next.

As in ``learned``, every candidate is scored by one small network from its own features and the context's, here those of
``observe.TOPIC_FIELDS`` too. At an arrival the *drop* network scores each message that may be evicted, and the newcomer
if it may be rejected; the *accept* network the newcomer where there is room. When the socket is free the *send* network
scores the oldest message of each topic. The highest score is done, ties to the oldest. It never holds the socket back.

One rule is not learned: ``no_drop`` messages go first, as Robofleet sends them. Such a message is lost only where
nothing but its like is queued, and that is not to be risked for a better score.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.kernel import kernel
from bufgym.model.buffer import ACCEPT, HOLD, REJECT, Buffer, is_first
from bufgym.observe import (
    CONTEXT_FIELDS,
    SLOT_FIELDS,
    TOPIC_CONTEXT_FIELDS,
    TOPIC_SLOT_FIELDS,
    observe_topic_context,
    observe_topic_slots,
)
from bufgym.policies.learned import Network, begin, forward
from bufgym.policies.registry import Policy
from bufgym.policies.robofleet import next_no_drop
from bufgym.policies.schedulers import fits, make_room, makes_room

SLOTS, CONTEXT = len(SLOT_FIELDS + TOPIC_SLOT_FIELDS), len(CONTEXT_FIELDS + TOPIC_CONTEXT_FIELDS)
NAMES = tuple(field.name for field in SLOT_FIELDS + TOPIC_SLOT_FIELDS + CONTEXT_FIELDS + TOPIC_CONTEXT_FIELDS)

# Where things lie in the memory.
INPUTS, CONTEXTS, WIDTH, DROP_NET, ACCEPT_NET, SEND_NET, WORK = range(7)
HEADER = 7


@kernel
def observed(buffer: Buffer, arrival: Any, arriving: bool, memory: NDArray[np.float64]) -> None:
    """Write the fields into the room to work in: the context's that are read into f, all slot fields into rows."""
    n, c, width, work = int(memory[INPUTS]), int(memory[CONTEXTS]), int(memory[WIDTH]), int(memory[WORK])
    at = work + 2 * n - c + 2 * width
    seen = memory[at : at + CONTEXT]
    rows = memory[at + CONTEXT : at + CONTEXT + SLOTS * (buffer.capacity + 1)].reshape((SLOTS, buffer.capacity + 1))
    observe_topic_context(buffer, arrival, arriving, seen)
    observe_topic_slots(buffer, arrival, arriving, rows)
    for i in range(c):
        memory[work + i] = seen[int(memory[HEADER + i])]


@kernel
def score(buffer: Buffer, k: int, net: int, after: int, memory: NDArray[np.float64]) -> float:
    """Of candidate ``k`` (L: the newcomer) by the network in ``memory[net:after]``; ``observed`` comes before."""
    n, c, width, work = int(memory[INPUTS]), int(memory[CONTEXTS]), int(memory[WIDTH]), int(memory[WORK])
    L = buffer.capacity
    network = memory[net:after]
    f, skip = memory[work : work + n], memory[work + n : work + 2 * n - c]
    h = memory[work + 2 * n - c : work + 2 * n - c + 2 * width]
    at = work + 2 * n - c + 2 * width + CONTEXT
    slot = f[c:]
    for i in range(c, n):
        slot[i - c] = memory[at + int(memory[HEADER + i]) * (L + 1) + k]
        skip[i - c] = network[i]
    return begin(network, f, c, n, width, h) + forward(network, skip, slot, c, n, width, 0, h)


def arrives(buffer: Buffer, arrival: Any, memory: NDArray[np.float64]) -> int:
    """A trained scheduler."""
    if len(buffer.topics) == 1:
        return make_room(buffer, arrival)  # one queue has no topics to tell apart
    drop, accept, send = int(memory[DROP_NET]), int(memory[ACCEPT_NET]), int(memory[SEND_NET])
    observed(buffer, arrival, True, memory)
    best, decision = -np.inf, REJECT
    for k in range(len(buffer.slots)):
        if makes_room(buffer, arrival, k):
            reached = score(buffer, k, drop, accept, memory)
            if reached > best:
                best, decision = reached, k
    if buffer.topics[arrival.topic].no_drop == 0:
        reached = score(buffer, buffer.capacity, drop, accept, memory)
        if reached > best:
            best, decision = reached, REJECT
    if fits(buffer, arrival) and (
        buffer.topics[arrival.topic].no_drop == 1 or score(buffer, buffer.capacity, accept, send, memory) >= best
    ):
        decision = ACCEPT
    return decision


def sends(buffer: Buffer, memory: NDArray[np.float64]) -> int:
    """The oldest message of the topic that scores highest."""
    if len(buffer.topics) == 1:
        return 0
    send, after = int(memory[SEND_NET]), int(memory[WORK])
    kept = next_no_drop(buffer, 0)
    if kept != HOLD:
        return kept
    observed(buffer, buffer.slots[0], False, memory)
    best, choice = -np.inf, HOLD
    for k in range(len(buffer.slots)):
        if is_first(buffer, k):
            reached = score(buffer, k, send, after, memory)
            if reached > best:
                best, choice = reached, k
    return choice


@dataclass(frozen=True)
class TopicWeights:
    """A scheduler's weights: which fields it reads, and its three networks, of one hidden layer at most."""

    fields: tuple[str, ...]
    drop: Network
    accept: Network
    send: Network

    @property
    def width(self) -> int:
        """Of the hidden layer; 0: none."""
        return len(self.drop.layers[0][1]) if self.drop.layers else 0

    def memory(self) -> NDArray[np.float64]:
        """The policy's memory, but for the room to work in."""
        context = [name for name in self.fields if NAMES.index(name) >= SLOTS]
        slot = [name for name in self.fields if NAMES.index(name) < SLOTS]
        order = [self.fields.index(name) for name in (*context, *slot)]
        read = [NAMES.index(name) - SLOTS for name in context] + [NAMES.index(name) for name in slot]
        nets = [network.flat(order) for network in (self.drop, self.accept, self.send)]
        places = np.cumsum([HEADER + len(self.fields), *map(len, nets)])
        return np.concatenate([[len(self.fields), len(context), self.width, *places], read, *nets])


def policy(name: str, weights: TopicWeights, summary: str = "", source: str = "") -> Policy:
    """The policy that these weights decide; it works for every L and any topics."""
    return Policy(
        name,
        arrives,
        on_send=sends,
        memory={f"w{i}": float(number) for i, number in enumerate(weights.memory())},
        source=source,
        compile=True,
        work=(2 * len(weights.fields) + 2 * weights.width + CONTEXT, SLOTS),
        about=summary,
        for_topics=True,
    )
