"""Learned policies among ordered candidates: a perceptron from a file, decided by a compiled forward pass. No torch.

The policy finds the k cheapest candidates and the head, observes them as the environment does
(``bufgym.model.observe.candidates``), and takes the action with the highest output of its network

    h <- f, the 6 (k + 1) + 9 observed numbers;  h <- g(W h + b) for each hidden layer;  outputs <- W h + b

where g is tanh or relu. With k + 1 outputs the network is asked at a full buffer alone. With k + 2 it is asked at every
arrival, and output 0 accepts the newcomer where there is room. See docs/methods.md, "Networks among candidates".
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
from bufgym.policies.scoring import add

CANDIDATES, MASKS, TANH, HIDDEN, WIDTHS = range(5)
"""Header of the parameters: k; whether actions that are not offered are left out; whether g is tanh; hidden
layers; then the width of each layer, outputs last. The layers' numbers follow: W, a row for each input, and b."""
_PER_CANDIDATE, _QUEUE = len(CANDIDATE_FIELDS), len(QUEUE_FIELDS)


def inputs(candidates: int) -> int:
    """The count of numbers observed for this many candidates."""
    return _PER_CANDIDATE * (candidates + 1) + _QUEUE


@kernel
def forward(parameters: NDArray[np.float64], units: NDArray[np.float64], size: int) -> int:
    """Compute each layer's units behind those of the layer before; the first ``size`` units are the inputs.

    Returns:
        The index of the first output in ``units``.
    """
    hidden, begin, weights = int(parameters[HIDDEN]), 0, WIDTHS + int(parameters[HIDDEN]) + 1
    for layer in range(hidden + 1):
        width = int(parameters[WIDTHS + layer])
        sums = units[begin + size : begin + size + width]
        for o in range(width):
            sums[o] = parameters[weights + size * width + o]
        for i in range(size):
            if units[begin + i] != 0:
                add(sums, units[begin + i], parameters, weights + i * width)
        if layer < hidden:
            for o in range(width):
                sums[o] = math.tanh(sums[o]) if parameters[TANH] == 1 else max(sums[o], 0.0)
        weights += (size + 1) * width
        begin += size
        size = width
    return begin


@kernel
def decide(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """The decision of the action with the highest output."""
    parameters = buffer.parameters
    places = int(parameters[CANDIDATES]) + 1
    actions = int(parameters[WIDTHS + int(parameters[HIDDEN])])
    at_arrivals, room = actions > places, has_space(buffer, arrival)
    if room and not at_arrivals:
        return ACCEPT
    order, cost, units = memory[:places], memory[places : 2 * places], memory[2 * places :]
    size = _PER_CANDIDATE * places + _QUEUE
    find_candidates(buffer, arrival, order, cost)
    observe_candidates(buffer, arrival, order, cost, units[:size])
    for i in range(size):
        units[i] = np.float32(units[i])  # environments show single precision
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

    def parameters(self) -> NDArray[np.float64]:
        """The network as parameters of ``decide``."""
        header = [self.candidates, self.masks, self.activation == "tanh", len(self.layers) - 1]
        widths = [len(bias) for _, bias in self.layers]
        numbers = [part.reshape(-1) for layer in self.layers for part in layer]
        return np.concatenate([header, widths, *numbers]).astype(np.float64)

    def tensors(self) -> dict[str, NDArray[np.float32]]:
        """The numbers by name, as in a file."""
        names = [*map(str, range(len(self.layers) - 1)), "out"]
        of = {f"{self.NETWORKS[0]}.{name}": layer for name, layer in zip(names, self.layers, strict=True)}
        return {f"{name}.{part}": layer[k] for name, layer in of.items() for k, part in enumerate(("weight", "bias"))}

    def policy(self, name: str, about: str = "", source: str = "") -> Policy:
        """Make the policy of these weights; it works for every L."""
        units = inputs(self.candidates) + sum(len(bias) for _, bias in self.layers)
        return Policy(
            name, on_arrival, weights=tuple(self.parameters().tolist()), work=(2 * (self.candidates + 1) + units, 0),
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

    @staticmethod
    def ends(settings: Mapping[str, Any]) -> tuple[int, int]:
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
