"""The measures and episodes by which a run's agent is trained, validated and reported."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from agents.report import Report, Trained
from agents.settings import Settings
from bufgym.policies import Policy


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
