"""A learner: one algorithm of ``train.py`` on the task of one run.

A new one is a file with a subclass of ``Learner``, and a class of settings that names it in ``settings.ALGORITHMS``.
"""

from __future__ import annotations

import math
import pkgutil
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Generic, TypeVar

from agents.objectives import OBJECTIVES
from agents.objectives.objective import Objective
from agents.runs import Run, each_seed
from agents.settings import Settings
from bufgym.policies import Policy, weights

S = TypeVar("S", bound=Settings)


class Learner(ABC, Generic[S]):
    """An algorithm with its settings.

    Args:
        settings: of the run.
        seconds: training ends after so many, if it has not ended before.
    """

    def __init__(self, settings: S, seconds: float = math.inf) -> None:
        self.settings, self.seconds = settings, seconds

    def objective(self, folder: Path, seed: int) -> Objective:
        """The task of the run for one seed: its environments, its episodes and its measures."""
        return OBJECTIVES[self.settings.kind](self.settings, folder, seed)

    def train(self, folder: Path) -> list[Run]:
        """Train every seed, in processes of their own if there are several."""
        self.objective(folder, self.settings.seed).prepare()
        return each_seed(self.train_seed, self.settings, folder)

    @abstractmethod
    def train_seed(self, folder: Path, seed: int, line: int = 0) -> Run:
        """Train one seed, from its last checkpoint if there is one, and keep what is best on validation.

        Args:
            folder: the run's folder.
            seed: the training seed; its files are in ``folder / f"seed-{seed}"``.
            line: line of the progress bar.
        """

    def agent(self, run: Run) -> Policy:
        """The agent that a run kept, for evaluations."""
        return weights.load(run.model)

    def notes(self, seed: int, name: str) -> dict[str, Any]:
        """Notes on its making, for the file of weights of a policy of this name."""
        suite = ",".join(self.settings.suites.names)
        return {"name": name, "suite": suite, "seeds": [seed], "algo": self.settings.algo}


def learner_of(settings: Settings, seconds: float = math.inf) -> Learner[Any]:
    """The learner that these settings name."""
    found: Learner[Any] = pkgutil.resolve_name(settings.learner)(settings, seconds)
    return found
