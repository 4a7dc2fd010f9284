"""Suites of one queue: the less of AFR's regret is left, the better."""

from __future__ import annotations

import functools
import math
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from agents.evaluation import ValidationSets, Verdict
from agents.mixed_env import MixedEnv, cells
from agents.objectives.objective import Objective
from agents.report import Report, Trained, report_suites
from bufgym.policies import Policy
from bufgym.sb3 import GymVecEnv


class SuitesObjective(Objective):
    """All suites of a run; a run is an episode at one L."""

    columns = Verdict._fields
    best = min
    message = "{2:.3f} of AFR's regret on validation"

    @functools.cached_property
    def judges(self) -> ValidationSets:
        """The suites' validation splits, made at first use."""
        return ValidationSets(self.settings, self.folder)

    def prepare(self) -> None:
        """Compute the clairvoyant's bounds."""
        ValidationSets(self.settings, self.folder, progress=True)

    def validate(self, agent: Policy) -> tuple[float, ...]:
        """The verdict on the validation splits."""
        return self.judges.play(agent)

    def env(self, num_envs: int, reward: str, **options: Any) -> VecEnv:
        """Whole train splits, about as many rows of each scenario at each L."""
        chosen = self.settings.suites
        mixed = [
            cell for suite in chosen.names for cell in cells(suite, "train", chosen.capacities_of(suite), chosen.data)
        ]
        size = math.ceil(num_envs / len(mixed))
        return GymVecEnv(MixedEnv(mixed, [size] * len(mixed), reward=reward, **options))

    def report(self, trained: Trained) -> Report:
        """A score on each suite, as ``bufgym bench`` computes it."""
        return report_suites(trained)
