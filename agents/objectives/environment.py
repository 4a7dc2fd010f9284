"""One environment: the more QoI, the better."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from agents.constants import NAMES, UNTAUGHT
from agents.held_out import FixedEpisodes, fixed_episodes, split_scenario
from agents.objectives.objective import Objective
from agents.report import Report, Trained, by_hand, report_environment
from bufgym import policies
from bufgym.oracle.measure import BASELINE
from bufgym.policies import Policy
from bufgym.sb3 import make_vec_env


class EnvironmentObjective(Objective):
    """The environment of a run."""

    columns = ("score", "qoi")
    best = max
    message = "score {0:.3f}, mean QoI {1:.3f} on validation"

    @functools.cached_property
    def judges(self) -> FixedEpisodes:
        """Other episodes on the training links."""
        return fixed_episodes(self.settings, "validation")

    def validate(self, agent: Policy) -> tuple[float, ...]:
        """Score and mean H on the validation episodes."""
        outcomes = self.judges.play(agent)
        # By QoI, which orders agents like the score, and is known even if nothing can be gained.
        return self.judges.score(outcomes), float(np.mean([outcome.qoi for outcome in outcomes]))

    def env(self, num_envs: int, reward: str, **options: Any) -> VecEnv:
        """Rows of the training links."""
        on = self.settings.environment
        scenario = split_scenario(on)[0]
        return make_vec_env(on.env, num_envs, scenario=scenario, capacity=on.capacity, reward=reward, **options)

    def lines_to_beat(self) -> dict[str, float]:
        """Drop Oldest, chance, AFR, constant actions and the best rule written by hand."""
        rules = [policies.get(name) for name in by_hand()]
        scores = {policy.name: self.judges.score(self.judges.play(policy)) for policy in (*rules, *UNTAUGHT)}
        best = max((rule.name for rule in rules), key=lambda name: scores[name])
        lines = {name: scores[name] for name in dict.fromkeys((BASELINE, "chance", "afr", *NAMES, best))}
        listed = ", ".join(f"{name} {score:.3f}" for name, score in lines.items())
        print(f"to beat on validation (score: 0 is {BASELINE}, 1 the clairvoyant): {listed}", flush=True)
        return lines

    def report(self, trained: Trained) -> Report:
        """A table and a figure of all agents and fixed policies on the held-out episodes."""
        return report_environment(trained)
