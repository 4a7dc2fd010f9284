"""stable-baselines3's own PPO and DQN among ordered candidates, and PPO on the slots of a fleet's robots."""

from __future__ import annotations

from typing import Any, TypeVar

import stable_baselines3 as sb3
from sb3_contrib import MaskablePPO
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv

from agents.decisions import DecisionLearner
from agents.settings import DQN, PPO, ActorCritic, FleetPPO, OnCandidates
from bufgym.sb3 import SlotPolicy
from bufgym.utils.errors import BufgymError

Candidates = TypeVar("Candidates", bound=OnCandidates)


class CandidateLearner(DecisionLearner[Candidates]):
    """An algorithm on the flat observation of ordered candidates; its agent is a compiled policy for every L."""

    @property
    def env_options(self) -> dict[str, Any]:
        """Asked at a full buffer, where every action is valid, so nothing is masked."""
        return {"candidates": self.settings.candidates, "info": "none"}


class CandidatePPO(CandidateLearner[PPO]):
    """PPO with the library's own network and settings."""

    algorithm = sb3.PPO

    def make(self, env: VecEnv) -> Any:
        """Make an untrained actor and critic."""
        settings = self.settings
        arguments = ppo_arguments(settings, env, settings.n_steps, settings.learning_rate)
        network = {"net_arch": [settings.width, settings.width]}
        return sb3.PPO("MlpPolicy", env, policy_kwargs=network, **arguments)


class CandidateDQN(CandidateLearner[DQN]):
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


class SlotPPO(DecisionLearner[FleetPPO]):
    """PPO with action masks that chooses a slot of a robot's buffer, for all robots of a fleet."""

    algorithm = MaskablePPO
    env_options = {"actions": "slots", "decide_at": "arrival"}

    def make(self, env: VecEnv) -> Any:
        """Make an untrained actor and critic."""
        settings = self.settings
        arguments = ppo_arguments(settings, env, settings.n_steps, LinearSchedule(settings.learning_rate, 0.0, 1.0))
        return MaskablePPO(SlotPolicy, env, policy_kwargs={"width": settings.width, "masked": True}, **arguments)


def ppo_arguments(settings: ActorCritic, env: VecEnv, n_steps: int, learning_rate: Any) -> dict[str, Any]:
    """The arguments of PPO's class that do not depend on its policy."""
    return {
        "learning_rate": learning_rate,
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
