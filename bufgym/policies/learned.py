"""Learned policies: a slot scorer's weights from a file, decided by a compiled forward pass. No torch, no code.

Every candidate (each queued message, and the newcomer) is scored by one small network from its own features and the
context's (``bufgym.observe``), so one set of weights serves every L:

    h = relu(W1 f + b1), then once more if there is a second layer;  score = w h + skip f + b

The score is that of dropping the candidate; a second network of the same kind gives the newcomer's score of being
accepted, which counts where there is room. The highest score is done, ties to the oldest. The context c may also mix in
how much the candidate's own features s count (``mix`` M): c M s is added to the score of dropping it, so that one
agent weighs a rank or a gap otherwise where V is straight than where it is flat.

A second scorer over the same fields, with hidden layers of its own, may decide while the link stands *still*
(``STILL``): thinning a queue that nothing leaves, for how long nobody knows, is another task than keeping step with a
slow link.

The file is safetensors with JSON metadata: reading it runs nothing.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.kernel import kernel
from bufgym.model.buffer import ACCEPT, REJECT, Buffer
from bufgym.observe import CONTEXT_FIELDS, FIELDS, SLOT_FIELDS, observe_context, observe_slots
from bufgym.policies.registry import Policy

SLOTS, CONTEXT = len(SLOT_FIELDS), len(CONTEXT_FIELDS)
NAMES = tuple(field.name for field in FIELDS)

FORMAT = 1
MAX_BYTES = 1 << 20
"""A file of more bytes is refused: a slot scorer has a few kilobytes."""
MAX_WIDTH = 256

# Where things lie in the memory.
INPUTS, CONTEXTS, FIRST, SECOND, ACCEPT_NET, MIX, OTHER, WORK = range(8)
"""Fields read, and how many of them are the context's; widths of the two layers (0: none); where the second network,
the mixing weights (0: none), the scorer for a link that stands still (0: none) and the room to work in begin."""
HEADER = 8

STILL = 0.07
"""The link stands still while its drain (running mean of departures per arrival) is less: from the first arrival of an
interruption on (1/16), or 41 arrivals after a link that kept up has stopped."""


@kernel
def begin(
    net: NDArray[np.float64], context: NDArray[np.float64], c: int, n: int, first: int, h: NDArray[np.float64]
) -> float:
    """What the context's c fields (the first of n inputs) add to every score; their part of layer 1 goes to h."""
    score = net[n]
    for i in range(c):
        score += net[i] * context[i]
    at = n + 1
    for o in range(first):
        h[o] = net[at + n * first + o]
    # Inputs in the outer loop: each is added to all sums side by side.
    for i in range(c):
        for o in range(first):
            h[o] += context[i] * net[at + i * first + o]
    return float(score)


@kernel
def forward(
    net: NDArray[np.float64],
    skip: NDArray[np.float64],
    slot: NDArray[np.float64],
    c: int,
    n: int,
    first: int,
    second: int,
    h: NDArray[np.float64],
) -> float:
    """What the candidate's own n - c fields add to ``begin``: the rest of the network.

    ``net``: skip and b; W1 (a row an input) and b1; W2 and b2; w. ``skip``: that of the candidate's fields, mixed.
    ``h``: layer 1 from ``begin``, then room for first + second numbers.
    """
    score = 0.0
    for i in range(n - c):
        score += skip[i] * slot[i]
    at, width, here = n + 1, first, first
    for o in range(first):
        h[first + o] = h[o]
    for i in range(c, n):
        for o in range(first):
            h[first + o] += slot[i - c] * net[at + i * first + o]
    if first > 0:
        at += (n + 1) * first
    if second > 0:
        here, width = 2 * first, second
        for o in range(second):
            h[here + o] = net[at + first * second + o]
        for i in range(first):
            seen = max(h[first + i], 0.0)
            for o in range(second):
                h[here + o] += seen * net[at + i * second + o]
        at += (first + 1) * second
    for o in range(width):
        score += net[at + o] * max(h[here + o], 0.0)
    return float(score)


def scorer(buffer: Buffer, arrival: Any, memory: NDArray[np.float64]) -> int:
    """A trained slot scorer."""
    if memory[OTHER] > 0 and buffer.service_ratio < STILL:
        return decided(buffer, arrival, memory[int(memory[OTHER]) :])
    return decided(buffer, arrival, memory)


@kernel
def decided(buffer: Buffer, arrival: Any, memory: NDArray[np.float64]) -> int:
    """By the scorer that the memory begins with."""
    s, L = len(buffer.slots), buffer.capacity
    n, c, first, second = int(memory[INPUTS]), int(memory[CONTEXTS]), int(memory[FIRST]), int(memory[SECOND])
    accept_net, work = int(memory[ACCEPT_NET]), int(memory[WORK])
    drop_net, mix = HEADER + n, int(memory[MIX])
    drop, accept = memory[drop_net:accept_net], memory[accept_net:work]
    f = memory[work : work + n]
    skip = memory[work + n : work + 2 * n - c]
    h = memory[work + 2 * n - c : work + 2 * n - c + 2 * first + second]
    at = work + 2 * n - c + 2 * first + second
    seen = memory[at : at + CONTEXT]
    rows = memory[at + CONTEXT : at + CONTEXT + SLOTS * (L + 1)].reshape((SLOTS, L + 1))
    observe_context(buffer, arrival, seen)
    observe_slots(buffer, arrival, rows)
    for i in range(c):
        f[i] = seen[int(memory[HEADER + i])]
    slot = f[c:]
    for i in range(n - c):
        skip[i] = drop[c + i]
    if mix > 0:
        for j in range(c):
            for i in range(n - c):
                skip[i] += f[j] * memory[mix + j * (n - c) + i]
    common = begin(drop, f, c, n, first, h)
    free = buffer.max_bytes - buffer.backlog_bytes - arrival.size_bytes
    best, decision = -np.inf, REJECT
    for candidate in range(s + 1):
        if candidate < s and free + buffer.slots[candidate].size_bytes < 0:
            continue  # its place would not suffice
        k = candidate if candidate < s else L
        for i in range(c, n):
            slot[i - c] = rows[int(memory[HEADER + i]), k]
        score = common + forward(drop, skip, slot, c, n, first, second, h)
        if score > best:
            best, decision = score, candidate if candidate < s else REJECT
    if s < L and free >= 0:
        # slot holds the newcomer's features still
        common = begin(accept, f, c, n, first, h)
        if common + forward(accept, accept[c:n], slot, c, n, first, second, h) >= best:
            decision = ACCEPT
    return decision


# --- weights -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Network:
    """One network's weights; ``layers``: (weights [inputs, outputs], bias [outputs]) of the hidden ones."""

    skip: NDArray[np.float32]
    bias: NDArray[np.float32]
    layers: tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...]
    out: NDArray[np.float32]

    def flat(self, order: Sequence[int] | slice = slice(None)) -> NDArray[np.float64]:
        """As ``forward`` reads them, inputs in this order."""
        parts = [self.skip[order], self.bias.reshape(1)]
        for k, (weight, bias) in enumerate(self.layers):
            parts += [(weight if k else weight[order]).reshape(-1), bias]
        return np.concatenate([*parts, self.out]).astype(np.float64)


@dataclass(frozen=True)
class Weights:
    """A slot scorer: which fields it reads, and its two networks."""

    fields: tuple[str, ...]
    drop: Network
    accept: Network
    mix: NDArray[np.float32] | None = None
    """[context fields, slot fields], each kind in the order of ``fields``: c M s is added to the score of a drop."""
    still: Weights | None = None
    """What decides while the link stands still, with the same fields; None: these do."""

    @property
    def context(self) -> tuple[str, ...]:
        """The fields that are the context's."""
        return tuple(name for name in self.fields if NAMES.index(name) >= SLOTS)

    @property
    def slot(self) -> tuple[str, ...]:
        """The fields that each candidate has of its own."""
        return tuple(name for name in self.fields if NAMES.index(name) < SLOTS)

    @property
    def widths(self) -> tuple[int, int]:
        """Of the two hidden layers; 0: none."""
        given = [len(bias) for _, bias in self.drop.layers]
        return (given[0] if given else 0), (given[1] if len(given) > 1 else 0)

    @property
    def work(self) -> int:
        """Numbers that a decision needs room for, besides those for each slot."""
        first, second = self.widths
        own = 2 * len(self.fields) + 2 * first + second + CONTEXT
        return own if self.still is None else max(own, self.still.work)

    def memory(self) -> NDArray[np.float64]:
        """The policy's memory, but for the room to work in."""
        if self.still is None:
            return self._block()
        other, alone = self.still._block(), self._block()
        return np.concatenate([self._block(other=len(alone), behind=len(other)), other])

    def _block(self, other: int = 0, behind: int = 0) -> NDArray[np.float64]:
        """One scorer; ``other``: where the second one begins, ``behind``: numbers between this one and the room."""
        first, second = self.widths
        context = self.context
        order = [self.fields.index(name) for name in (*context, *self.slot)]
        drop, accept = self.drop.flat(order), self.accept.flat(order)
        mix = (np.zeros(0) if self.mix is None else self.mix).reshape(-1).astype(np.float64)
        accept_net = HEADER + len(self.fields) + len(drop)
        mixing = accept_net + len(accept)
        places = [accept_net, mixing if len(mix) else 0, other, mixing + len(mix) + behind]
        head = [len(self.fields), len(context), first, second, *places]
        numbers = [NAMES.index(self.fields[i]) for i in order]
        read = [number - SLOTS if number >= SLOTS else number for number in numbers]
        return np.concatenate([head, read, drop, accept, mix])


def policy(name: str, weights: Weights, summary: str = "", source: str = "") -> Policy:
    """The policy that these weights decide; it works for every L."""
    memory = weights.memory()
    return Policy(
        name,
        scorer,
        memory={f"w{i}": float(number) for i, number in enumerate(memory)},
        source=source,
        compile=True,
        work=(weights.work, SLOTS),
        about=summary,
    )


def random_weights(fields: tuple[str, ...], widths: tuple[int, ...], rng: np.random.Generator) -> Weights:
    """Small random weights."""

    def network() -> Network:
        sizes = [len(fields), *widths]
        layers = tuple(
            (rng.normal(0, 1 / np.sqrt(a), (a, b)).astype(np.float32), np.zeros(b, np.float32))
            for a, b in itertools.pairwise(sizes)
        )
        out = np.zeros(widths[-1] if widths else 0, np.float32)
        return Network(np.zeros(len(fields), np.float32), np.zeros(1, np.float32), layers, out)

    return Weights(fields, network(), network())
