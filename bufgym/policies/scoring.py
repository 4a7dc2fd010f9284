"""The slot scorer shared by learned policies: its networks, their layout as parameters, and the forward pass.

A candidate is a queued message or the newcomer. Its features f are the context's fields, then its own. A network scores
it as

    h = relu(W1 f + b1), then once more if there is a second layer;  score = w h + skip f + b

The parameters of a scorer are one row of numbers: a header, the fields that it reads, and its networks one after
another. ``learned.Weights.parameters`` writes this layout, ``unpack`` reads it.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel, unchecked_table

HEADER = 5
"""Numbers before the fields: fields read, the context's share of them, widths of both layers, size of one network."""
DROP, KEEP = range(2)
"""Networks of a scorer, in the order of its parameters: they score dropping and accepting a candidate."""
OF_INPUTS = {"skip", "0.weight"}  # Tensors of a network whose first axis is the inputs


class Scorer(NamedTuple):
    """A scorer's parameters, unpacked into sizes and views."""

    context: int
    """Number of context fields."""
    first: int
    """Width of the first hidden layer; 0 if there is none."""
    second: int
    """Width of the second hidden layer; 0 if there is none."""
    fields: NDArray[np.float64]
    """[inputs]: position of each field in the observation of its kind, the context's fields first."""
    networks: NDArray[np.float64]
    """One after another, ``size`` numbers each: skip and b, W1 (a row for each input) and b1, W2 and b2, then w."""
    size: int
    """Numbers of one network."""


class Scratch(NamedTuple):
    """A policy's memory while it decides."""

    f: NDArray[np.float64]
    """[inputs]: the features of the present candidate, the context's fields first."""
    skip: NDArray[np.float64]
    """[slot fields]: direct weights of the candidate's own fields."""
    h: NDArray[np.float64]
    """[2 first + second]: sums of the hidden layers; the first layer's sums for the context alone come first."""
    context: NDArray[np.float64]
    """[all context fields]: the observed context."""
    rows: NDArray[np.float64]
    """[all slot fields, L + 1]: the observed slots, the newcomer's last."""


@kernel
def unpack(parameters: NDArray[np.float64]) -> Scorer:
    """The scorer of these parameters."""
    inputs, context = int(parameters[0]), int(parameters[1])
    first, second, size = int(parameters[2]), int(parameters[3]), int(parameters[4])
    nets = HEADER + inputs
    return Scorer(context, first, second, parameters[HEADER:nets], parameters[nets:], size)


@kernel
def divide(memory: NDArray[np.float64], scorer: Scorer, contexts: int, slots: int, capacity: int) -> Scratch:
    """Divide the memory into room for one decision, with ``contexts`` and ``slots`` observed fields."""
    skip = len(scorer.fields)
    h = skip + len(scorer.fields) - scorer.context
    context = h + 2 * scorer.first + scorer.second
    rows = context + contexts
    table = unchecked_table(memory[rows:], slots, capacity + 1)
    return Scratch(memory[:skip], memory[skip:h], memory[h:context], memory[context:rows], table)


@kernel
def begin(scorer: Scorer, which: int, scratch: Scratch) -> float:
    """The context's part of every score by network ``which``; its part of the first layer goes to ``scratch.h``."""
    net = scorer.networks[which * scorer.size : (which + 1) * scorer.size]
    f, h, skip = scratch.f, scratch.h, scratch.skip
    n, c, first = len(f), scorer.context, scorer.first
    for i in range(n - c):
        skip[i] = net[c + i]
    score = net[n]
    for i in range(c):
        score += net[i] * f[i]
    weights = n + 1
    for o in range(first):
        h[o] = net[weights + n * first + o]
    # Inputs in the outer loop: each is added to all sums side by side.
    for i in range(c):
        add(h[:first], f[i], net, weights + i * first)
    return float(score)


@kernel
def score(scorer: Scorer, which: int, common: float, k: int, scratch: Scratch) -> float:
    """The score of candidate ``k`` by network ``which``, given ``common`` from ``begin``; k = L is the newcomer."""
    net = scorer.networks[which * scorer.size : (which + 1) * scorer.size]
    n, c, first, second = len(scorer.fields), scorer.context, scorer.first, scorer.second
    h, slot, own_fields = scratch.h, scratch.f[c:], scorer.fields[c:]
    for i in range(n - c):
        slot[i] = scratch.rows[int(own_fields[i]), k]
    own = 0.0
    for i in range(n - c):
        own += scratch.skip[i] * slot[i]
    weights, sums = n + 1, h[first : 2 * first]
    for o in range(first):
        sums[o] = h[o]
    for i in range(n - c):
        add(sums, slot[i], net, weights + (c + i) * first)
    if first > 0:
        weights += (n + 1) * first
    if second > 0:
        units, sums = sums, h[2 * first : 2 * first + second]
        for o in range(second):
            sums[o] = net[weights + first * second + o]
        for i in range(first):
            if units[i] > 0:
                add(sums, units[i], net, weights + i * second)
        weights += (first + 1) * second
    for o in range(len(sums)):
        own += net[weights + o] * max(sums[o], 0.0)
    return common + own


@kernel
def add(sums: NDArray[np.float64], unit: float, net: NDArray[np.float64], begin: int) -> None:
    """Add ``unit`` times the weights from ``begin`` on to the sums."""
    at = np.uint64(begin)
    for o in range(np.uint64(len(sums))):  # an unsigned index is not checked, so many sums are added to at once
        sums[o] += unit * net[at + o]


@dataclass(frozen=True)
class Network:
    """The weights of one network, float32."""

    skip: NDArray[np.float32]
    """[inputs]: the direct part of the score."""
    bias: NDArray[np.float32]
    """[1]"""
    layers: tuple[tuple[NDArray[np.float32], NDArray[np.float32]], ...]
    """Weights [inputs, outputs] and bias [outputs] of each hidden layer."""
    out: NDArray[np.float32]
    """[outputs of the last hidden layer]; empty without one."""

    @property
    def widths(self) -> tuple[int, ...]:
        """Units of each hidden layer."""
        return tuple(len(bias) for _, bias in self.layers)

    def flat(self, order: Sequence[int] | slice = slice(None)) -> NDArray[np.float64]:
        """All numbers as in ``Scorer.networks``, with the inputs in this order."""
        parts = [tensor[order] if name in OF_INPUTS else tensor for name, tensor in self.tensors().items()]
        return np.concatenate([part.reshape(-1) for part in parts]).astype(np.float64)

    def tensors(self) -> dict[str, NDArray[np.float32]]:
        """Name -> tensor: skip, bias, 0.weight, 0.bias, 1.weight, ..., out."""
        tensors = {"skip": self.skip, "bias": self.bias}
        for k, (weight, bias) in enumerate(self.layers):
            tensors |= {f"{k}.weight": weight, f"{k}.bias": bias}
        return tensors | {"out": self.out}

    @staticmethod
    def of(tensors: Mapping[str, NDArray[np.float32]], prefix: str) -> Network:
        """Make the network of the ``tensors`` whose names begin with this."""
        own = {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
        hidden = sum(name.endswith(".weight") for name in own)
        layers = tuple((own[f"{k}.weight"], own[f"{k}.bias"]) for k in range(hidden))
        return Network(own["skip"], own["bias"], layers, own["out"])

    @staticmethod
    def shapes(inputs: int, widths: Sequence[int]) -> dict[str, tuple[int, ...]]:
        """The shapes of ``tensors``, by name."""
        shapes: dict[str, tuple[int, ...]] = {"skip": (inputs,), "bias": (1,)}
        for k, shape in enumerate(itertools.pairwise([inputs, *widths])):
            shapes |= {f"{k}.weight": shape, f"{k}.bias": shape[1:]}
        return shapes | {"out": (widths[-1] if widths else 0,)}
