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
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor, nn

from agents.callbacks import BetweenUpdates, Curve
from agents.held_out import split_scenario
from agents.settings import Settings
from bufgym.policies import guided
from bufgym.policies.guided import GuidedWeights
from bufgym.sb3 import make_vec_env

ENVS, N_STEPS, MINIBATCH, EPOCHS = 256, 128, 4_096, 4
"""Batches of 33,000 decisions; 7,000 fail."""
DISCOUNT, TRACE = 0.9, 0.9
"""gamma and lambda."""
RATE, WIDTH = 1e-3, 32
"""Learning rate, which falls linearly to 0, and hidden units of the critic's two layers."""
PLAIN = list(guided.INPUTS).index("plain")
SPREADS = (0.3, 0.1)
"""Standard deviation of the actions, at the start and at the end."""


def training_env(settings: Settings) -> VecEnv:
    """Environments whose actions set the rule's numbers."""
    return make_vec_env(
        settings.env,
        ENVS,
        scenario=split_scenario(settings)[0],
        capacity=settings.capacity,
        reward=settings.reward,
        decide_at="arrival",
        actions="guided",
        fields="guided",
        observation="flat",
    )


class Inputs(BaseFeaturesExtractor):
    """The rule's inputs, zero where the plain rule stays."""

    def __init__(self, observation_space: spaces.Box) -> None:
        super().__init__(observation_space, guided.N_INPUTS)

    def forward(self, observation: Tensor) -> Tensor:
        """The inputs of n decisions, [n, inputs]."""
        return observation * (1 - observation[:, PLAIN, None])


class GuidedPolicy(ActorCriticPolicy):
    """A linear actor that begins at zero, without bias as one input is always 1; and a critic with hidden layers."""

    def __init__(self, *args: Any, **settings: Any) -> None:
        own = {"net_arch": {"pi": [], "vf": [WIDTH, WIDTH]}, "features_extractor_class": Inputs}
        super().__init__(*args, **{**settings, **own})
        actor: Any = self.action_net
        for parameter in (actor.weight, actor.bias):
            nn.init.zeros_(parameter)
        actor.bias.requires_grad_(False)
        self.log_std.requires_grad_(False)


def new(settings: Settings, env: VecEnv) -> PPO:
    """An agent that is still the rule."""
    steps = min(N_STEPS, max(1, settings.steps // env.num_envs))
    return PPO(
        GuidedPolicy,
        env,
        learning_rate=LinearSchedule(RATE, 0.0, 1.0),
        n_steps=steps,
        batch_size=math.gcd(MINIBATCH, steps * env.num_envs),
        n_epochs=EPOCHS,
        gamma=DISCOUNT,
        gae_lambda=TRACE,
        device="cpu",
    )


def weights_of(model: PPO) -> GuidedWeights:
    """The actor's weights."""
    policy: Any = model.policy
    weight: NDArray[np.float32] = policy.action_net.weight.detach().numpy()
    return GuidedWeights((weight * guided.SCALES[:, None]).astype(np.float32))


class Budget(BetweenUpdates):
    """Ends the training after so many seconds, and narrows the actions over its steps."""

    def __init__(self, seconds: float, curve: Curve, steps: int) -> None:
        super().__init__()
        self.seconds, self.curve, self.steps = seconds, curve, steps

    def _on_step(self) -> bool:
        return self.curve.spent() < self.seconds

    def _on_rollout_start(self) -> None:
        policy: Any = self.model.policy
        nn.init.constant_(policy.log_std, math.log(np.interp(self.num_timesteps / self.steps, (0, 1), SPREADS)))
