"""PPO on the numbers of a rule: a linear actor that begins at the rule, and explores ever less.

The critic has hidden layers, the actor has none, so what PPO finds is a file like CMA-ES's. PPO is best early and then
drifts to worse, so validation says which weights to keep.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv

from agents.callbacks import BetweenUpdates, Curve
from agents.held_out import split_scenario
from agents.settings import Settings
from bufgym.policies import guided
from bufgym.policies.guided import GuidedWeights
from bufgym.sb3 import make_vec_env

ENVS, N_STEPS, MINIBATCH, EPOCHS = 256, 168, 3_584, 4
"""Batches of 43,000 decisions; 7,000 fail."""
DISCOUNT, TRACE = 0.99, 0.95
"""gamma and lambda. With 0.9 and 0.9 it is best within 16 s and then drifts to worse than the rule."""
RATE, WIDTH = 1e-3, 64
"""Learning rate, and hidden units of the critic's two layers."""
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


def new(settings: Settings, env: VecEnv) -> PPO:
    """An actor of zeros, which is the rule."""
    layers = {"pi": [], "vf": [WIDTH, WIDTH]}
    steps = min(N_STEPS, max(1, settings.steps // env.num_envs))
    model = PPO(
        "MlpPolicy",
        env,
        learning_rate=RATE,
        n_steps=steps,
        batch_size=math.gcd(MINIBATCH, steps * env.num_envs),
        n_epochs=EPOCHS,
        gamma=DISCOUNT,
        gae_lambda=TRACE,
        policy_kwargs={"net_arch": layers},
        device="cpu",
    )
    policy: Any = model.policy
    with torch.no_grad():
        policy.action_net.weight.zero_()
        policy.action_net.bias.zero_()
    return model


def weights_of(model: PPO) -> GuidedWeights:
    """The actor's weights; the bias counts for the input that is always 1."""
    policy: Any = model.policy
    actor = policy.action_net
    weight: NDArray[np.float32] = actor.weight.detach().numpy().copy()
    weight[:, list(guided.INPUTS).index("one")] += actor.bias.detach().numpy()
    return GuidedWeights((weight * guided.SCALES[:, None]).astype(np.float32))


class Budget(BetweenUpdates):
    """Ends the training after so many seconds, and narrows the actions until then."""

    def __init__(self, seconds: float, curve: Curve, steps: int) -> None:
        super().__init__()
        self.seconds, self.curve, self.steps = seconds, curve, steps

    def _on_step(self) -> bool:
        return self.curve.spent() < self.seconds

    def _on_rollout_start(self) -> None:
        done = min(max(self.curve.spent() / self.seconds, self.num_timesteps / self.steps), 1.0)
        policy: Any = self.model.policy
        spread = policy.log_std
        spread.requires_grad_(False)
        with torch.no_grad():
            spread.fill_(float(np.log(SPREADS[0]) + done * np.log(SPREADS[1] / SPREADS[0])))
