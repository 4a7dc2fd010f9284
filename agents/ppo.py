"""PPO on the slots of the buffer, with action masks or without."""

from __future__ import annotations

from typing import Any

import stable_baselines3 as sb3
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.policies import MaskableMultiInputActorCriticPolicy
from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from agents.decisions import SlotLearner
from agents.settings import PPO, ActorCritic
from bufgym.sb3 import SlotPolicy, weights_of
from bufgym.utils.errors import BufgymError


class SlotPPO(SlotLearner[PPO]):
    """PPO that chooses a slot; with the slot network its agent is a compiled policy, which serves every L."""

    @property
    def algorithm(self) -> Any:
        """MaskablePPO, or PPO without masks."""
        return sb3.PPO if self.settings.unmasked else MaskablePPO

    def make(self, env: VecEnv) -> Any:
        """Make an untrained actor and critic."""
        settings = self.settings
        policy, arguments = network_of(settings)
        return self.algorithm(policy, env, policy_kwargs=arguments, **ppo_arguments(settings, env, settings.n_steps))

    def weights_of(self, model: Any) -> Any:
        """The slot network's weights if it is asked at every arrival, as a policy is, and needs no mask of torch."""
        settings = self.settings
        return weights_of(model) if settings.scores_slots and settings.decide_at == "arrival" else None


def network_of(settings: PPO) -> tuple[Any, dict[str, Any]]:
    """The actor-critic class and its arguments: the slot network, or a plain one over all numbers at once."""
    if settings.network == "slots":
        return SlotPolicy, {"width": settings.width, "masked": not settings.unmasked, "prior": settings.prior}
    plain = MultiInputActorCriticPolicy if settings.unmasked else MaskableMultiInputActorCriticPolicy
    return plain, {"net_arch": [2 * settings.width, 2 * settings.width], "activation_fn": nn.ReLU}


def ppo_arguments(settings: ActorCritic, env: VecEnv, n_steps: int) -> dict[str, Any]:
    """The arguments of PPO's class that do not depend on its policy."""
    return {
        "learning_rate": LinearSchedule(settings.learning_rate, 0.0, 1.0),
        "n_steps": n_steps,
        "batch_size": even_batch(n_steps * env.num_envs, settings.batch_size),
        "n_epochs": settings.epochs,
        "gamma": settings.gamma,
        "gae_lambda": settings.gae_lambda,
        "ent_coef": settings.entropy,
        "stats_window_size": env.num_envs,
        "device": "cpu",
    }


def even_batch(decisions: int, most: int) -> int:
    """The largest batch size up to ``most`` that divides the decisions, so that no noisy rest is left."""
    batches = -(-decisions // most)
    while decisions % batches:
        batches += 1
    if decisions // batches < 2:
        rule = f"num_envs x n_steps = {decisions} decisions an update must have a divisor from 2 to it"
        raise BufgymError(f"batch_size = {most}: {rule}")
    return decisions // batches
