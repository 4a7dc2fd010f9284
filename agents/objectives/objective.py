"""The objective of the evolution loop, and weights as the vector that is searched."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.settings import Settings
from bufgym.policies import Policy, learned
from bufgym.policies.guided import GuidedWeights
from bufgym.policies.learned import Network, Weights
from bufgym.policies.weights import AnyWeights

Vector = NDArray[np.float64]


class Objective(ABC):
    """One kind of task: the start of a search, the comparison of candidates, the choice of the agent to keep.

    Training episodes come in parts, one a generation in turn, so that many episodes cost no more than a few.

    Args:
        settings: the run's settings.
        folder: the run's folder.
        seed: the training seed, which training episodes are drawn from.
    """

    name: str
    """Name of its policies."""
    columns: tuple[str, ...]
    """Names of the measures of ``validate``; the last one chooses the agent to keep."""
    best: Callable[..., Any]
    """``min`` or ``max``, the better direction of that last measure."""
    message: str
    """Format of that measure in words."""
    sigma: float
    """First step size."""
    training: Any
    """Training episodes by part; each set has ``decisions``, the approximate number per candidate."""
    judges: Any
    """The validation episodes."""

    def __init__(self, settings: Settings, folder: Path, seed: int) -> None:
        self.settings, self.folder, self.seed = settings, folder, seed

    @abstractmethod
    def start(self) -> AnyWeights:
        """The weights at which the search begins."""

    @abstractmethod
    def measure(self, policy: Policy, episodes: Any) -> float:
        """The measure that compares candidates, on these episodes."""

    def fitness(self, policy: Policy, part: int) -> float:
        """The fitness of a candidate on a part of the training episodes: the less the better."""
        measure = self.measure(policy, self.training[part % len(self.training)])
        return -measure if self.best is max else measure

    def decisions(self, part: int) -> int:
        """Decisions of one candidate on a part."""
        return sum(episodes.decisions for episodes in self.training[part % len(self.training)])

    def validate(self, policy: Policy) -> tuple[float, ...]:
        """The measures of an agent on the validation episodes."""
        return (self.measure(policy, self.judges),)


# --- weights as a vector ---------------------------------------------------------------------------------------------


def to_vector(weights: AnyWeights) -> Vector:
    """The searched numbers, float64[n]: networks one after the other, then the mixing.

    Context and bias add the same to every candidate's score, so they matter in ``accept`` alone, which stays linear.
    """
    if isinstance(weights, GuidedWeights):
        return weights.weight.reshape(-1).astype(np.float64)
    numbers, searched = _numbers(weights)
    return np.concatenate(numbers)[np.concatenate(searched)]


def with_vector(weights: AnyWeights, vector: Vector) -> Any:
    """These weights with the searched numbers replaced."""
    if isinstance(weights, GuidedWeights):
        return type(weights)(vector.reshape(weights.weight.shape).astype(np.float32))
    parts, searched = _numbers(weights)
    numbers = np.concatenate(parts)
    numbers[np.concatenate(searched)] = vector
    *networks, mix = np.split(numbers, np.cumsum([len(part) for part in parts[:-1]]))
    changes: dict[str, Any] = {
        name: _network(getattr(weights, name), flat) for name, flat in zip(weights.NETWORKS, networks, strict=True)
    }
    if weights.mix is not None:
        changes["mix"] = mix.reshape(weights.mix.shape).astype(np.float32)
    return replace(weights, **changes)


def _numbers(weights: Weights) -> tuple[list[Vector], list[NDArray[np.bool_]]]:
    """(numbers, whether each is searched) of every network and, last, of the mixing."""
    inputs = len(weights.fields)
    numbers, searched = [], []
    for name in weights.NETWORKS:
        flat = getattr(weights, name).flat()
        if name == "accept":
            mask = np.arange(len(flat)) <= inputs
        else:
            mask = np.ones(len(flat), np.bool_)
            mask[:inputs] = [learned.NAMES.index(field) < learned.SLOTS for field in weights.fields]
            mask[inputs] = False
        numbers.append(flat)
        searched.append(mask)
    numbers.append(np.zeros(0) if weights.mix is None else weights.mix.reshape(-1))
    searched.append(np.ones(len(numbers[-1]), np.bool_))
    return numbers, searched


def _network(like: Network, flat: Vector) -> Network:
    """The network of that shape with these numbers."""
    shapes = [like.skip.shape, (1,), *(array.shape for layer in like.layers for array in layer), like.out.shape]
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    skip, bias, *layers, out = (
        part.reshape(shape).astype(np.float32) for part, shape in zip(np.split(flat, ends[:-1]), shapes, strict=True)
    )
    return Network(skip, bias, tuple(zip(layers[::2], layers[1::2], strict=True)), out)
