"""PPO on the numbers of a rule: a linear actor that begins at the rule, and explores ever less.

The critic has hidden layers, the actor has none, so what PPO finds is a file like CMA-ES's. PPO is best early and then
drifts to worse, so validation says which weights to keep.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from agents.callbacks import BetweenUpdates, Curve
from agents.decisions import DecisionLearner
from agents.ppo import ppo_arguments
from agents.settings import GuidedPPO
from bufgym.policies import guided
from bufgym.policies.guided import GuidedWeights

PLAIN = list(guided.INPUTS).index("plain")
SPREADS = (0.3, 0.1)
"""Standard deviation of the actions, at the start and at the end."""
OPTIONS = {"decide_at": "arrival", "actions": "guided", "fields": "guided", "observation": "flat"}
"""Of environments whose actions set the rule's numbers."""


class Inputs(BaseFeaturesExtractor):
    """The rule's inputs, zero where the plain rule stays."""

    def __init__(self, observation_space: spaces.Box) -> None:
        super().__init__(observation_space, guided.N_INPUTS)

    def forward(self, observation: Tensor) -> Tensor:
        """The inputs of n decisions, [n, inputs]."""
        return observation * (1 - observation[:, PLAIN, None])


class GuidedPolicy(ActorCriticPolicy):
    """A linear actor that begins at zero, without bias as one input is always 1; and a critic with hidden layers."""

    def __init__(self, *args: Any, width: int = 32, **settings: Any) -> None:
        own = {"net_arch": {"pi": [], "vf": [width, width]}, "features_extractor_class": Inputs}
        super().__init__(*args, **{**settings, **own})
        actor: Any = self.action_net
        for parameter in (actor.weight, actor.bias):
            nn.init.zeros_(parameter)
        actor.bias.requires_grad_(False)
        self.log_std.requires_grad_(False)


class Narrowing(BetweenUpdates):
    """Narrows the actions over so many steps."""

    def __init__(self, steps: int) -> None:
        super().__init__()
        self.steps = steps

    def _on_rollout_start(self) -> None:
        policy: Any = self.model.policy
        nn.init.constant_(policy.log_std, math.log(np.interp(self.num_timesteps / self.steps, (0, 1), SPREADS)))


class GuidedLearner(DecisionLearner[GuidedPPO]):
    """PPO on the rule's numbers; its agent is a compiled policy."""

    algorithm = PPO
    env_options = OPTIONS

    def make(self, env: VecEnv) -> PPO:
        """Make an actor that is still the rule, and a critic."""
        settings = self.settings
        n_steps = min(settings.n_steps, max(1, settings.steps // env.num_envs))
        arguments = ppo_arguments(settings, env, n_steps, LinearSchedule(settings.learning_rate, 0.0, 1.0))
        return PPO(GuidedPolicy, env, policy_kwargs={"width": settings.width}, **arguments)

    def weights_of(self, model: Any) -> GuidedWeights:
        """The actor's weights."""
        weight: NDArray[np.float32] = model.policy.action_net.weight.detach().numpy()
        return GuidedWeights((weight * guided.SCALES[:, None]).astype(np.float32))

    def callbacks(self, curve: Curve) -> list[BaseCallback]:
        """The usual ones, and ``Narrowing``."""
        return [*super().callbacks(curve), Narrowing(self.settings.steps)]
