"""One environment's episodes, for an agent that sets the numbers of a rule: the more QoI, the better.

The search begins at the rule, with weights of zero, and goes in small steps: residual policy learning
[silver2018residual]. Candidates meet the same episodes, so a mean of QoI compares them, and no bound is needed.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from agents.evaluation import qoi_of
from agents.held_out import FixedEpisodes, fixed_episodes, split_scenario
from agents.objectives.objective import Objective
from bufgym.benchmark.run import draw
from bufgym.policies import Policy
from bufgym.scenario import Episode
from bufgym.sim import Senders
from bufgym.sim.metrics import Outcome

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


class GuidedObjective(Objective):
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

    def validate(self, policy: Policy) -> tuple[float, ...]:
        """Score and mean H on the validation episodes."""
        return self._measures(self.judges.run(policy))

    def validate_learner(self, learner: Any) -> tuple[float, ...]:
        """The same of a learner."""
        return self._measures(self.judges.play(learner, self.settings.environment))

    def _measures(self, outcomes: Sequence[Outcome]) -> tuple[float, ...]:
        # By QoI, which orders agents like the score, and is known even if nothing can be gained.
        return self.judges.score(outcomes), float(np.mean([outcome.qoi for outcome in outcomes]))
