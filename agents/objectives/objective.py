"""The measures and episodes by which a run's agent is trained, validated and reported."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv

from agents.report import Report, Trained, report_rows
from agents.settings import Settings
from bufgym.policies import Policy
from bufgym.policies.guided import N_INPUTS, N_OUTPUTS, GuidedWeights

Vector = NDArray[np.float64]


class Objective(ABC):
    """One kind of task: the environments to learn in, the choice of the agent to keep, its report.

    Args:
        settings: the run's settings.
        folder: the run's folder.
        seed: the training seed, which training episodes are drawn from.
    """

    columns: tuple[str, ...]
    """Names of the measures of ``validate``; the last one chooses the agent to keep."""
    best: Callable[..., Any]
    """``min`` or ``max``, the better direction of that last measure."""
    message: str
    """Format of the measures in words."""
    judges: Any
    """The validation episodes."""

    def __init__(self, settings: Settings, folder: Path, seed: int) -> None:
        self.settings, self.folder, self.seed = settings, folder, seed

    def prepare(self) -> None:
        """Do once for all seeds what each would do for itself."""
        return

    @abstractmethod
    def validate(self, agent: Policy) -> tuple[float, ...]:
        """The measures of an agent on the validation episodes."""

    def env(self, num_envs: int, reward: str, **options: Any) -> VecEnv:
        """Environments to learn from single decisions in; ``options`` are those of the learner's actions."""
        raise NotImplementedError

    def lines_to_beat(self) -> dict[str, float]:
        """The validation scores to beat, of fixed policies by name; they are printed as well."""
        return {}

    @abstractmethod
    def report(self, trained: Trained) -> Report:
        """Compare the agents of all seeds with the fixed policies."""


class Evolved(Objective):
    """A task whose agent may be evolved: one measure compares candidates and validates.

    Training episodes come in parts, one a generation in turn, so that many episodes cost no more than a few.
    """

    name: str
    """Name of its candidates."""
    sigma = 0.02
    """First step size; 0.1 diverges."""
    training: Any
    """Training episodes by part; each set has ``decisions``, the approximate number per candidate."""

    def start(self) -> GuidedWeights:
        """The weights at which the search begins: zeros, the plain rule."""
        return GuidedWeights(np.zeros((N_OUTPUTS, N_INPUTS), np.float32))

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

    def validate(self, agent: Policy) -> tuple[float, ...]:
        """The measure on the validation episodes."""
        return (self.measure(agent, self.judges),)

    def rivals(self) -> list[Policy]:
        """The fixed policies that agents are compared with on the test split."""
        raise NotImplementedError

    def report(self, trained: Trained) -> Report:
        """A row of the benchmark for each agent and fixed policy in each episode of the test split."""
        return report_rows(trained, self.rivals())
