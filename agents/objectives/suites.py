"""Suites of one queue, for an agent that sets the numbers of a rule: the less of AFR's regret is left, the better."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from agents.evaluation import ValidationSets, Verdict
from agents.families import Family, divided, merged, of_suite
from agents.mixed_env import MixedEnv, cells
from agents.objectives.objective import Objective
from agents.report import Report, Trained, report_suites
from bufgym.policies import Policy
from bufgym.sb3 import GymVecEnv
from bufgym.utils.errors import BufgymError

PARTS, RUNS = 8, 60
"""Parts of the training runs, and runs of each suite in a part."""


class SuitesObjective(Objective):
    """All suites of a run; a run is an episode at one L."""

    name = "guided"
    columns = Verdict._fields
    best = min
    message = "{2:.3f} of AFR's regret on validation"

    @functools.cached_property
    def training(self) -> list[list[Family]]:
        """A family of runs of each suite, in parts."""
        chosen, rng = self.settings.suites, np.random.default_rng(self.seed)
        by_suite = []
        for suite in chosen.suite:
            runs = merged(of_suite(suite, "train", chosen.capacities, data=chosen.data))
            by_suite.append(divided(suite, runs, min(RUNS, len(runs)), PARTS, rng))
            if not all((family.best > family.afr).any() for family in by_suite[-1]):
                raise BufgymError(f"suite {suite}: AFR loses nothing there, so nothing can be learned")
        return [list(part) for part in zip(*by_suite, strict=True)]

    @functools.cached_property
    def judges(self) -> ValidationSets:
        """The suites' validation splits, made at first use: a worker that evaluates candidates needs none."""
        return ValidationSets(self.settings, self.folder)

    def prepare(self) -> None:
        """Compute the clairvoyant's bounds."""
        ValidationSets(self.settings, self.folder, progress=True)

    def measure(self, policy: Policy, episodes: list[Family]) -> float:
        """Share of AFR's regret, mean over the suites."""
        return float(np.mean([family.share(policy) for family in episodes]))

    def validate(self, agent: Policy) -> tuple[float, ...]:
        """The verdict on the validation splits."""
        return self.judges.play(agent)

    def env(self, num_envs: int, reward: str, **options: Any) -> VecEnv:
        """Whole train splits, about as many rows of each scenario at each L."""
        chosen = self.settings.suites
        mixed = [
            cell for suite in chosen.suite for cell in cells(suite, "train", chosen.capacities_of(suite), chosen.data)
        ]
        size = math.ceil(num_envs / len(mixed))
        return GymVecEnv(MixedEnv(mixed, [size] * len(mixed), reward=reward, **options))

    def report(self, trained: Trained) -> Report:
        """A score on each suite, as ``bufgym bench`` computes it."""
        return report_suites(trained)
