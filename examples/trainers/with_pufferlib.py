"""PufferLib 2.0.2: its vector of environments and its network.

Its trainer is a script of its repository. The loop below takes its place.
"""

import gymnasium as gym
import pufferlib.emulation
import pufferlib.models
import pufferlib.vector
import torch
from torch.distributions import Categorical

import bufgym  # noqa: F401  (registers the environments)


def made(**buffers):
    env = gym.make("bufgym/Uplink-v1", capacity=8, reward="regret", info="mask")
    return pufferlib.emulation.GymnasiumPufferEnv(env, **buffers)


envs = pufferlib.vector.make(made, num_envs=8, backend=pufferlib.vector.Serial)
policy = pufferlib.models.Default(envs.driver_env)
optimizer = torch.optim.Adam(policy.parameters(), 1e-3)
observation, _ = envs.reset(seed=0)
for _ in range(200):  # one-step policy gradient, the place of its trainer's update
    logits, value = policy(torch.as_tensor(observation))
    choice = Categorical(logits=logits)
    action = choice.sample()
    observation, reward, *_ = envs.step(action.numpy())
    advantage = torch.as_tensor(reward - reward.mean(), dtype=torch.float32)
    optimizer.zero_grad()
    (-choice.log_prob(action) * advantage).mean().backward()
    optimizer.step()
