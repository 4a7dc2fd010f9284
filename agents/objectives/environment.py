"""One environment's episodes, for an agent that sets the numbers of a rule: the more QoI, the better.

The search begins at the rule, with weights of zero, and goes in small steps: residual policy learning
[silver2018residual]. Candidates meet the same episodes, so a mean of QoI compares them, and no bound is needed.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from agents.evaluation import Agent, qoi_of
from agents.held_out import FixedEpisodes, fixed_episodes, split_scenario
from agents.objectives.objective import Objective
from agents.report import Report, Trained, by_hand, report_environment
from bufgym import policies
from bufgym.oracle import BASELINE
from bufgym.policies import Policy
from bufgym.sb3 import make_vec_env
from bufgym.scenario import Episode
from bufgym.scenario.numbered import draw
from bufgym.sim import Senders

PARTS, EPISODES = 18, 100
"""Parts of the training episodes, and episodes in each."""
FIRST_SEED = 10_000
"""Seeds of training episodes count up from here times 1 + the training seed."""


class Played:
    """Episodes of one scenario at one L, loaded anew for each candidate."""

    def __init__(self, episodes: Sequence[Episode], capacity: int, senders: Senders) -> None:
        self.episodes, self.capacity, self._senders = episodes, capacity, senders
        self.decisions = sum(len(episode.arrivals) for episode in episodes)

    def qoi(self, policy: Policy) -> float:
        """Mean H."""
        return float(qoi_of(policy, self._senders, self.episodes).mean())


class EnvironmentObjective(Objective):
    """The environment of a run."""

    name = "guided"
    columns = ("score", "qoi")
    best = max
    message = "score {0:.3f}, mean QoI {1:.3f} on validation"

    @functools.cached_property
    def training(self) -> list[list[Played]]:
        """New episodes on the training links, in parts."""
        on = self.settings.environment
        scenario, L = split_scenario(on)[0], on.capacity
        senders = Senders(EPISODES, L, scenario.value, max_messages=scenario.max_messages)
        seeds = FIRST_SEED * (1 + self.seed) + np.arange(PARTS * EPISODES).reshape(PARTS, EPISODES)
        return [[Played([draw(scenario, int(seed)) for seed in part], L, senders)] for part in seeds]

    @functools.cached_property
    def judges(self) -> FixedEpisodes:
        """Other episodes on the training links."""
        return fixed_episodes(self.settings, "validation")

    def measure(self, policy: Policy, episodes: Sequence[Played]) -> float:
        """Mean H over all episodes of a part."""
        return float(np.mean([played.qoi(policy) for played in episodes]))

    def validate(self, agent: Agent) -> tuple[float, ...]:
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
        """Drop Oldest, AFR and the best rule written by hand."""
        scores = {name: self.judges.score(self.judges.play(policies.get(name))) for name in by_hand()}
        best = max(scores, key=lambda name: scores[name])
        lines = {name: scores[name] for name in dict.fromkeys((BASELINE, "afr", best))}
        listed = ", ".join(f"{name} {score:.3f}" for name, score in lines.items())
        print(f"to beat on validation (score: 0 is {BASELINE}, 1 the clairvoyant): {listed}", flush=True)
        return lines

    def report(self, trained: Trained) -> Report:
        """A table and a figure of all agents and fixed policies on the held-out episodes."""
        return report_environment(trained)
