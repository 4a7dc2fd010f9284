"""Learned policies among ordered candidates: a perceptron from a file, decided by a compiled forward pass. No torch.

The policy finds the k cheapest candidates and the head, observes them as the environment does
(``bufgym.model.observe.candidates``), and takes the action with the highest output of its network

    h <- f, the 6 (k + 1) + 9 observed numbers;  h <- g(W h + b) for each hidden layer;  outputs <- W h + b

where g is tanh or relu, in single precision. With k + 1 outputs the network is asked at a full buffer alone. With
k + 2 it is asked at every arrival, and output 0 accepts the newcomer where there is room. See docs/methods.md,
"Networks among candidates".
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel
from bufgym.model.buffer import ACCEPT, Buffer, has_space
from bufgym.model.observe import (
    CANDIDATE_FIELDS,
    QUEUE_FIELDS,
    decision_of_candidate,
    find_candidates,
    is_offered,
    observe_candidates,
)
from bufgym.model.observe.candidates import MOST_CANDIDATES
from bufgym.policies.registry import Arrival, Memory, Policy

CANDIDATES, MASKS, TANH, HIDDEN, WIDTHS = range(5)
"""Header of the parameters: k; whether actions that are not offered are left out; whether g is tanh; hidden
layers; then the width of each layer, outputs last. The layers' numbers follow, two of single precision in each
parameter, the first in its lower half: W, a row for each input, and b."""
_PER_CANDIDATE, _QUEUE = len(CANDIDATE_FIELDS), len(QUEUE_FIELDS)


def inputs(candidates: int) -> int:
    """The count of numbers observed for this many candidates."""
    return _PER_CANDIDATE * (candidates + 1) + _QUEUE


Singles = NDArray[np.float32]


@kernel
def forward(parameters: NDArray[np.float64], units: Singles, size: int) -> int:
    """Compute each layer's units behind those of the layer before; the first ``size`` units are the inputs.

    ``units`` ends with room for as many numbers as the widest layer but the last has, inputs being one.

    A sum begins with b and adds the inputs that are not zero in their order, each product rounded before it is added.

    Returns:
        The index of the first output in ``units``.
    """
    hidden, begin, weights = int(parameters[HIDDEN]), 0, 0
    numbers = parameters[WIDTHS + hidden + 1 :].view(np.float32)
    for layer in range(hidden + 1):
        width = int(parameters[WIDTHS + layer])
        above, sums = units[begin : begin + size], units[begin + size : begin + size + width]
        bias = numbers[weights + size * width :]
        for o in range(np.uint64(width)):
            sums[o] = bias[o]
        count, live = 0, units[len(units) - size :]
        for i in range(np.uint64(size)):  # without a branch, which half of the units would mispredict
            live[np.uint64(count)] = np.int32(i).view(np.float32)
            count += 1 if above[i] != 0 else 0
        fours = count - count % 4
        for k in range(0, fours, 4):
            add_four(sums, above, numbers, weights, live[k : k + 4])
        for k in range(fours, count):
            add(sums, above, numbers, weights, live[k])
        if layer < hidden and parameters[TANH] == 1:
            for o in range(width):
                sums[o] = math.tanh(sums[o])
        elif layer < hidden:
            for o in range(np.uint64(width)):
                sums[o] = max(sums[o], np.float32(0))
        weights += (size + 1) * width
        begin += size
        size = width
    return begin


@kernel
def add(sums: Singles, above: Singles, numbers: Singles, begin: int, live: Any) -> None:
    """Add a unit times its row of weights to the sums."""
    i = np.uint64(live.view(np.int32))
    row = np.uint64(begin + i * len(sums))
    unit = above[i]
    for o in range(np.uint64(len(sums))):
        sums[o] += unit * numbers[row + o]


@kernel
def add_four(sums: Singles, above: Singles, numbers: Singles, begin: int, live: Singles) -> None:
    """``add`` of four units, in this order: sums are loaded and stored once, which takes most of the time."""
    n = len(sums)
    i = np.uint64(live[0].view(np.int32))
    j = np.uint64(live[1].view(np.int32))
    k = np.uint64(live[2].view(np.int32))
    m = np.uint64(live[3].view(np.int32))
    a, b, c, d = above[i], above[j], above[k], above[m]
    row_i = np.uint64(begin + i * n)
    row_j = np.uint64(begin + j * n)
    row_k = np.uint64(begin + k * n)
    row_m = np.uint64(begin + m * n)
    for o in range(np.uint64(n)):
        x = (sums[o] + a * numbers[row_i + o]) + b * numbers[row_j + o]
        sums[o] = (x + c * numbers[row_k + o]) + d * numbers[row_m + o]


@kernel
def singles(count: int) -> int:
    """Entries of a memory or of parameters that hold so many numbers of single precision."""
    return (count + 1) // 2


@kernel
def decide(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """The decision of the action with the highest output."""
    parameters = buffer.parameters
    places = int(parameters[CANDIDATES]) + 1
    actions = int(parameters[WIDTHS + int(parameters[HIDDEN])])
    at_arrivals, room = actions > places, has_space(buffer, arrival)
    if room and not at_arrivals:
        return ACCEPT
    order, cost, units = memory[:places], memory[places : 2 * places], memory[2 * places :].view(np.float32)
    size = _PER_CANDIDATE * places + _QUEUE
    find_candidates(buffer, arrival, order, cost)
    observe_candidates(buffer, arrival, order, cost, units[:size])
    outputs = units[forward(parameters, units, size) :]
    best, action = -np.inf, 0
    for a in range(actions):
        if outputs[a] > best and (parameters[MASKS] == 0 or is_offered(order, at_arrivals, room, a)):
            best, action = outputs[a], a
    return decision_of_candidate(order, len(buffer.slots), at_arrivals, room, action)


def on_arrival(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """A trained network that chooses among ordered candidates."""
    return decide(buffer, arrival, memory)


Layer = tuple[NDArray[np.float32], NDArray[np.float32]]
"""Weights [inputs, outputs] and bias [outputs]."""
ACTIVATIONS = ("relu", "tanh")


@dataclass(frozen=True)
class CandidateWeights:
    """A network among ordered candidates, as in a file."""

    SLOT_NAMES: ClassVar[tuple[str, ...]] = tuple(field.name for field in CANDIDATE_FIELDS)
    CONTEXT_NAMES: ClassVar[tuple[str, ...]] = tuple(field.name for field in QUEUE_FIELDS)
    NETWORKS: ClassVar[tuple[str, ...]] = ("candidates",)
    LAYERS: ClassVar[int] = 3
    SETTINGS: ClassVar[Mapping[str, tuple[Callable[[Any], bool], str]]] = {
        "candidates": (
            lambda k: isinstance(k, int) and not isinstance(k, bool) and 1 <= k <= MOST_CANDIDATES,
            f"must be a whole number from 1 to {MOST_CANDIDATES}",
        ),
        "at_arrivals": (lambda asked: isinstance(asked, bool), "must be true or false"),
        "masks": (lambda masked: isinstance(masked, bool), "must be true or false"),
        "activation": (lambda name: name in ACTIVATIONS, f"must be one of {', '.join(ACTIVATIONS)}"),
    }
    """Further entry of a file's metadata -> check of its value, and the rule in words."""

    candidates: int
    """k: how many of the cheapest candidates have an action, beside the head."""
    at_arrivals: bool
    """Whether the network is asked at every arrival; otherwise at a full buffer alone."""
    masks: bool
    """Whether actions that are not offered are left out. Otherwise such an action does what the cheapest does."""
    activation: str
    """"relu" or "tanh"."""
    layers: tuple[Layer, ...]
    """Hidden layers, then the outputs."""

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the observed fields."""
        return self.SLOT_NAMES + self.CONTEXT_NAMES

    @property
    def widest(self) -> int:
        """Numbers of the widest layer but the last, inputs being one."""
        return max(len(weight) for weight, _ in self.layers)

    def parameters(self) -> NDArray[np.float64]:
        """The network as parameters of ``decide``."""
        header = [self.candidates, self.masks, self.activation == "tanh", len(self.layers) - 1]
        widths = [len(bias) for _, bias in self.layers]
        numbers = np.concatenate([part.reshape(-1) for layer in self.layers for part in layer], dtype=np.float32)
        pairs = np.zeros(2 * singles(len(numbers)), "<f4")
        pairs[: len(numbers)] = numbers  # finite, so that no pair reads as one that is not a number
        return np.concatenate([header, widths, pairs.view("<f8")]).astype(np.float64)

    def tensors(self) -> dict[str, NDArray[np.float32]]:
        """The numbers by name, as in a file."""
        names = [*map(str, range(len(self.layers) - 1)), "out"]
        of = {f"{self.NETWORKS[0]}.{name}": layer for name, layer in zip(names, self.layers, strict=True)}
        return {f"{name}.{part}": layer[k] for name, layer in of.items() for k, part in enumerate(("weight", "bias"))}

    def policy(self, name: str, about: str = "", source: str = "") -> Policy:
        """Make the policy of these weights; it works for every L."""
        units = inputs(self.candidates) + sum(len(bias) for _, bias in self.layers) + self.widest
        work = 2 * (self.candidates + 1) + singles(units), 0
        return Policy(
            name, on_arrival, weights=tuple(self.parameters().tolist()), work=work,
            compile=True, built_in=True, reads_rate=True, reads_left=True, about=about, source=source,
        )  # fmt: skip

    @staticmethod
    def definition(fields: Sequence[str]) -> list[Any]:
        """What defines the observation: weights found with another one would decide nonsense."""
        return [(field.name, field.per, field.unit, field.meaning) for field in (*CANDIDATE_FIELDS, *QUEUE_FIELDS)]

    @staticmethod
    def inputs_text(fields: Sequence[str], settings: Mapping[str, Any]) -> str:
        """What the shapes follow from."""
        asked = "at arrivals" if settings["at_arrivals"] else "at a full buffer"
        return f"{settings['candidates']} candidates, {asked},"

    @classmethod
    def ends(cls, settings: Mapping[str, Any]) -> tuple[int, int]:
        """How many numbers go in, and how many come out."""
        k = settings["candidates"]
        return inputs(k), k + 1 + settings["at_arrivals"]

    @classmethod
    def shapes(
        cls, fields: Sequence[str], widths: Sequence[int], given: Mapping[str, Any], settings: Mapping[str, Any]
    ) -> dict[str, tuple[int, ...]]:
        """The shapes of ``tensors`` for hidden layers of these widths, by name."""
        shapes, (seen, actions) = dict[str, tuple[int, ...]](), cls.ends(settings)
        names = [*map(str, range(len(widths))), "out"]
        for name, shape in zip(names, itertools.pairwise([seen, *widths, actions]), strict=True):
            shapes[f"{cls.NETWORKS[0]}.{name}.weight"] = shape
            shapes[f"{cls.NETWORKS[0]}.{name}.bias"] = shape[1:]
        return shapes

    @classmethod
    def of(
        cls, fields: Sequence[str], tensors: Mapping[str, NDArray[np.float32]], settings: Mapping[str, Any]
    ) -> "CandidateWeights":
        """Make the weights of these ``tensors`` and ``settings``."""
        names = [*map(str, range(len(tensors) // 2 - 1)), "out"]
        own = [f"{cls.NETWORKS[0]}.{name}." for name in names]
        return cls(**settings, layers=tuple((tensors[name + "weight"], tensors[name + "bias"]) for name in own))
