"""One policy for all robots of a cell, learned with PPO of Ray's RLlib and masked invalid actions.

    pip install ".[rllib]" torch
    python examples/fleet_rllib.py --robots 4 --iterations 20

Every robot decides from its own observation with the same weights, and is rewarded with the team's mean information.
The code is written for Ray 2.60 with RLlib's RLModule API stack.
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.spaces.utils import flatten, flatten_space
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.core.rl_module.multi_rl_module import MultiRLModuleSpec
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.rllib.examples.rl_modules.classes.action_masking_rlm import ActionMaskingTorchRLModule
from ray.tune.registry import register_env

from bufgym.envs import FleetEnv

SHARED = "every robot"
"""The one module that all agents are mapped to."""


class MaskedFleet(ParallelPettingZooEnv):
    """The fleet with observations for RLlib's action masking: {"observations": flat vector, "action_mask": floats}."""

    def __init__(self, config: dict[str, Any]) -> None:
        super().__init__(FleetEnv(**config))
        self._fields = self.par_env.observation_space("robot_0")
        actions = self.par_env.action_space("robot_0").n
        space = gym.spaces.Dict(
            {
                "observations": flatten_space(self._fields),
                "action_mask": gym.spaces.Box(0.0, 1.0, (actions,), np.float32),
            }
        )
        self.observation_spaces = dict.fromkeys(self.possible_agents, space)
        self.action_spaces = dict.fromkeys(self.possible_agents, self.par_env.action_space("robot_0"))
        self.observation_space = gym.spaces.Dict(self.observation_spaces)
        self.action_space = gym.spaces.Dict(self.action_spaces)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        observations, infos = super().reset(seed=seed, options=options)
        return self._masked(observations, infos), infos

    def step(self, action_dict: dict[str, Any]) -> Any:
        observations, rewards, terminated, truncated, infos = super().step(action_dict)
        return self._masked(observations, infos), rewards, terminated, truncated, infos

    def _masked(self, observations: dict[str, Any], infos: dict[str, Any]) -> dict[str, Any]:
        return {
            agent: {
                "observations": flatten(self._fields, observation),
                "action_mask": infos[agent]["action_mask"].astype(np.float32),
            }
            for agent, observation in observations.items()
        }


def configuration(runners: int = 0, batch: int = 4_000, **fleet: Any) -> PPOConfig:
    """Configure PPO on a fleet with ``runners`` sampling processes, 0 for this one, and ``batch`` ticks an
    iteration."""
    register_env("bufgym-fleet", MaskedFleet)
    return (
        PPOConfig()
        .environment("bufgym-fleet", env_config=fleet)
        .env_runners(num_env_runners=runners)
        .training(train_batch_size_per_learner=batch, minibatch_size=min(batch, 512), num_epochs=4, lr=3e-4)
        .multi_agent(policies={SHARED}, policy_mapping_fn=lambda agent, episode, **_: SHARED)
        .rl_module(
            rl_module_spec=MultiRLModuleSpec(
                rl_module_specs={SHARED: RLModuleSpec(module_class=ActionMaskingTorchRLModule)}
            )
        )
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--iterations", type=int, default=20)
    parser.add_argument("--runners", type=int, default=0, help="processes that sample")
    parser.add_argument("--ticks", type=int, default=4_000, help="ticks an iteration")
    parser.add_argument("--seconds", type=float, default=30.0, help="length of an episode")
    options = parser.parse_args()
    fleet = {"robots": options.robots, "capacity": 8, "duration_s": options.seconds}
    algorithm = configuration(options.runners, options.ticks, **fleet).build_algo()
    for iteration in range(options.iterations):
        runs = algorithm.train()["env_runners"]
        print(f"iteration {iteration}: {runs['num_episodes']} episodes, return {runs['episode_return_mean']:.2f}")
    algorithm.stop()


if __name__ == "__main__":
    main()
