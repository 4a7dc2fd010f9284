"""stable-baselines3's own PPO and DQN among ordered candidates."""

from __future__ import annotations

from typing import Any

import stable_baselines3 as sb3
from stable_baselines3.common.vec_env import VecEnv

from agents.decisions import DecisionLearner
from agents.settings import DQN, PPO
from bufgym.utils.errors import BufgymError


class CandidatePPO(DecisionLearner[PPO]):
    """PPO with the library's own network and settings."""

    algorithm = sb3.PPO

    def make(self, env: VecEnv) -> Any:
        """Make an untrained actor and critic."""
        settings = self.settings
        return sb3.PPO(
            "MlpPolicy",
            env,
            learning_rate=settings.learning_rate,
            n_steps=settings.n_steps,
            batch_size=even_batch(settings.n_steps * env.num_envs, settings.batch_size),
            n_epochs=settings.epochs,
            gamma=settings.gamma,
            gae_lambda=settings.gae_lambda,
            ent_coef=settings.entropy,
            stats_window_size=env.num_envs,
            policy_kwargs={"net_arch": [settings.width, settings.width]},
            device="cpu",
        )


class CandidateDQN(DecisionLearner[DQN]):
    """DQN with the library's own network and settings.

    A resumed learner begins with an empty replay.
    """

    algorithm = sb3.DQN

    def make(self, env: VecEnv) -> Any:
        """Make an untrained Q network."""
        settings = self.settings
        return sb3.DQN(
            "MlpPolicy",
            env,
            learning_rate=settings.learning_rate,
            buffer_size=max(settings.buffer_size, env.num_envs),
            learning_starts=settings.learning_starts,
            batch_size=settings.batch_size,
            gamma=settings.gamma,
            train_freq=(settings.train_freq, "step"),
            gradient_steps=settings.gradient_steps,
            target_update_interval=settings.target_update_interval,
            stats_window_size=env.num_envs,
            policy_kwargs={"net_arch": [settings.width, settings.width]},
            device="cpu",
        )


def even_batch(decisions: int, most: int) -> int:
    """The largest batch size up to ``most`` that divides the decisions, so that no noisy rest is left."""
    batches = -(-decisions // most)
    while decisions % batches:
        batches += 1
    if decisions // batches < 2:
        rule = f"num_envs x n_steps = {decisions} decisions an update must have a divisor from 2 to it"
        raise BufgymError(f"batch_size = {most}: {rule}")
    return decisions // batches
