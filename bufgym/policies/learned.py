"""Learned policies: a slot scorer's weights from a file, decided by a compiled forward pass. No torch, no code.

One small network scores every candidate, a queued message or the newcomer. Its inputs are the features of the candidate
and of the context (``model.observe``), so one set of weights serves every L; ``scoring`` has the formula. The *drop*
network scores dropping the candidate. The *accept* network scores accepting the newcomer, where there is room. The
policy takes the decision that scores highest; ties go to the oldest message.

The context c may also change the weights of the candidate's own features s, by the matrix ``mix`` M: the score of
dropping it grows by c M s. So one agent can weigh a rank or a gap differently where V is straight and where it is flat.

While the link stands *still* (``STILL``), a second scorer may decide over the same fields, with hidden layers of its
own. To thin a queue for an unknown time while nothing leaves is a different task from keeping up with a slow link.

With ``shortcuts`` an agent leaves some decisions to better rules, if it can tell on board that they are better. If V is
straight and then flat, ``greedy-qoi`` decides: gaps up to the bend of V lose nothing, so no plan is better for any
length of interruption. ``greedy-qoi`` also decides on a steady link with uneven motion, where the queue is sent as it
stands and there is no trap. While nothing leaves at all, a queue of at most four messages follows the exact plan
(``small_queue``). An agent that does not read motion takes shortcuts only where each message moves the scene equally
far. V of a number of messages is then known, and x and V serve it for that alone.

With ``thins`` an agent also thins its queue to the link, even with room. Once something has been sent, ``target_gap``
decides better than any scorer so far; on a steady link ``thinning`` says what to drop with room. The scorers decide
where there is no target, and the rest on steady links. Gaps are measured in motion if the agent reads it, otherwise in
messages.

The file is safetensors with JSON metadata: reading it runs nothing.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bufgym.ground.kernel import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer, has_space
from bufgym.model.observe import (
    CONTEXT_FIELDS,
    ON_BOARD_FIELDS,
    ON_BOARD_SLOT_FIELDS,
    SLOT_FIELDS,
    observe_context,
    observe_on_board,
    observe_on_board_slots,
    observe_slots,
)
from bufgym.model.qoi import straight
from bufgym.policies.gaps import MESSAGES, MOTION, greedy_qoi, smallest_gap
from bufgym.policies.registry import Arrival, Memory, Policy
from bufgym.policies.scoring import (
    DROP,
    KEEP,
    Network,
    Scorer,
    ScorerWeights,
    begin,
    divide,
    end_of,
    read_context,
    score,
    unpack,
)
from bufgym.policies.small_queue import NONE, NUMBERS, packed, planned
from bufgym.policies.target_gap import REMEMBERED, approach, bursty, remember, target
from bufgym.policies.thinning import STEADY, spare, steady

__all__ = ["NAMES", "Network", "Weights", "policy", "random_weights"]

SLOT_NAMES = tuple(field.name for field in (*SLOT_FIELDS, *ON_BOARD_SLOT_FIELDS))
CONTEXT_NAMES = tuple(field.name for field in (*CONTEXT_FIELDS, *ON_BOARD_FIELDS))
NAMES = SLOT_NAMES + CONTEXT_NAMES
SLOTS, CONTEXT = len(SLOT_NAMES), len(CONTEXT_NAMES)
# Fields beyond these are observed only if they are read.
TABLE_SLOTS, TABLE = len(SLOT_FIELDS), len(CONTEXT_FIELDS)

STILL = 0.07
"""The link stands still while its service ratio, a running mean of departures per arrival, is below this. That is so
from the first arrival of an interruption on (1/16), and 41 arrivals after a link that kept up has stopped."""
FLOWS, FEW = 0.18, 3
"""A queue is soon sent if at least ``FLOWS`` messages leave per arrival, or L is at most ``FEW``."""
LEAVES, THINS, SEES_MOTION = 1, 2, 4
"""Flags whose sum is the first of an agent's parameters."""
OWN = len(REMEMBERED)
"""Memory entries before the scratch, in an agent that thins."""
_greedy_qoi = kernel(greedy_qoi)


@kernel
def even(buffer: Buffer, arrival: Arrival) -> bool:
    """Whether the scene moves evenly from message to message."""
    moved, step = arrival.x - buffer.dequeued_x, arrival.x - buffer.previous_x
    return bool(abs(step * (arrival.seq - buffer.dequeued_seq) - moved) <= STEADY * moved)


@kernel
def best_drop(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """The best decision: of a shortcut, of the target gap, or else of the scorer."""
    flags, end, runs_evenly = int(buffer.parameters[0]), len(buffer.parameters), even(buffer, arrival)
    thins, measured_in = bool(flags & THINS), MOTION if flags & SEES_MOTION else MESSAGES
    leaves = flags & LEAVES and (flags & SEES_MOTION or runs_evenly)
    if flags & LEAVES:
        end -= NUMBERS
    if thins:
        remember(buffer, arrival, memory, measured_in)
        thins = not bursty(memory)
    if leaves and straight(buffer.v):
        return _greedy_qoi(buffer, arrival, memory)
    if steady(buffer):
        if thins and has_space(buffer, arrival):
            smallest = smallest_gap(buffer, arrival, measured_in, 0.0)
            if spare(buffer, arrival, smallest, measured_in):
                return smallest
        # Greed has no trap here, as the queue is soon sent. Where the scene moves evenly the scorer does better.
        if leaves and not runs_evenly and (buffer.service_ratio >= FLOWS or buffer.capacity <= FEW):
            return _greedy_qoi(buffer, arrival, memory)
    elif thins:
        g = target(buffer, arrival, memory, measured_in)
        if g > 0:
            return approach(buffer, arrival, g, measured_in)
    still = buffer.service_ratio < STILL
    if leaves and still and buffer.drained_bytes == 0:
        plan = planned(buffer, arrival, buffer.parameters[end:])
        if plan != NONE:
            return plan
    at = end_of(buffer.parameters, 1, 2) if still else 1
    scorer = unpack(buffer.parameters, at if at < end else 1, 2)
    own = memory[OWN:] if flags & THINS else memory
    return scored(buffer, arrival, scorer, measured_in if thins and not still else 0, own)


@kernel
def scored(buffer: Buffer, arrival: Arrival, scorer: Scorer, measured_in: int, memory: Memory) -> int:
    """The decision with the highest score; unless ``measured_in`` is 0, a queue with room may drop a spare message."""
    s, L = len(buffer.slots), buffer.capacity
    scratch = divide(memory, scorer, CONTEXT, SLOTS, L)
    observe_context(buffer, arrival, scratch.context[:TABLE])
    for i in range(scorer.context):
        if scorer.fields[i] >= TABLE:
            observe_on_board(buffer, arrival, scratch.context[TABLE:])
            break
    observe_slots(buffer, arrival, scratch.rows[:TABLE_SLOTS])
    for i in range(scorer.context, len(scorer.fields)):
        if scorer.fields[i] >= TABLE_SLOTS:
            observe_on_board_slots(buffer, arrival, scratch.rows[TABLE_SLOTS:])
            break
    read_context(scorer, scratch)
    common = begin(scorer, DROP, scratch)
    best, decision = -np.inf, REJECT
    for k in range(s + 1):
        dropped = score(scorer, DROP, common, k if k < s else L, scratch)
        if dropped > best:
            best, decision = dropped, k if k < s else REJECT
    if has_space(buffer, arrival):
        if measured_in and spare(buffer, arrival, decision, measured_in):
            return decision
        common = begin(scorer, KEEP, scratch)
        if score(scorer, KEEP, common, L, scratch) >= best:
            decision = ACCEPT
    return decision


def on_arrival(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """A trained slot scorer."""
    return best_drop(buffer, arrival, memory)


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
    still: Weights | None = None
    """Weights over the same fields that decide while the link stands still; None to use these weights."""
    shortcuts: bool = False
    """Whether ``greedy-qoi`` and exact plans decide where they are better."""
    thins: bool = False
    """Whether the agent thins the queue to the link."""

    def parameters(self) -> NDArray[np.float64]:
        """The policy's numbers: flags, this scorer, the scorer for a standing link, and the shortcuts' plans."""
        scorers = [self] if self.still is None else [self, self.still]
        plans = [packed()] if self.shortcuts else []
        flags = LEAVES * self.shortcuts + THINS * self.thins + SEES_MOTION * ("motion_merged" in self.fields)
        return np.concatenate([[float(flags)], *(scorer.pack(scorer.mix) for scorer in scorers), *plans])

    def reading(self, fields: tuple[str, ...]) -> Weights:
        """Weights for more ``fields`` that give the same decisions; the new fields have weight 0."""
        new = tuple(name for name in fields if name not in self.fields)
        drop, accept = (network.with_inputs(len(new)) for network in (self.drop, self.accept))
        still = self.still and self.still.reading(fields)
        more = replace(self, fields=self.fields + new, drop=drop, accept=accept, still=still)
        if self.mix is None:
            return more
        rows, columns = (len(more.context) - len(self.context), len(more.slot) - len(self.slot))
        return replace(more, mix=np.pad(self.mix, ((0, rows), (0, columns))))


def policy(name: str, weights: Weights, summary: str = "", source: str = "") -> Policy:
    """Make the policy of these weights; it works for every L."""
    scratch = max(scorer.scratch for scorer in (weights, weights.still or weights))
    numbers = tuple(weights.parameters().tolist())
    return Policy(
        name,
        on_arrival,
        weights=numbers,
        memory=REMEMBERED if weights.thins else {},
        work=(scratch, SLOTS),
        source=source,
        about=summary,
        reads_rate=weights.shortcuts or weights.thins or not set(CONTEXT_NAMES[TABLE:]).isdisjoint(weights.fields),
        compile=True,
    )


def random_weights(fields: tuple[str, ...], widths: tuple[int, ...], rng: np.random.Generator) -> Weights:
    """Small random weights in the hidden layers, zeros elsewhere."""

    def network() -> Network:
        layers = tuple(
            (rng.normal(0, 1 / np.sqrt(inputs), (inputs, outputs)).astype(np.float32), np.zeros(outputs, np.float32))
            for inputs, outputs in itertools.pairwise([len(fields), *widths])
        )
        out = np.zeros(widths[-1] if widths else 0, np.float32)
        return Network(np.zeros(len(fields), np.float32), np.zeros(1, np.float32), layers, out)

    return Weights(fields, network(), network())
