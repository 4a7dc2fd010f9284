"""torch alone, in CleanRL's style: the native batch takes the place of ``SyncVectorEnv``.

The shortest update that learns: a policy gradient of one step. ``examples/ppo.py`` is the whole of PPO in this style.
"""

import gymnasium as gym
import torch
from torch import nn
from torch.distributions import Categorical

import bufgym  # noqa: F401  (registers the environments)

envs = gym.make_vec("bufgym/Uplink-v1", num_envs=64, capacity=8, reward="regret", autoreset_mode="SameStep")
inputs, actions = envs.single_observation_space.shape[0], int(envs.single_action_space.n)
actor = nn.Sequential(nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, actions))
optimizer = torch.optim.Adam(actor.parameters(), 1e-3)
observation, _ = envs.reset(seed=0)
for _ in range(100):
    choice = Categorical(logits=actor(torch.as_tensor(observation)))
    action = choice.sample()
    observation, reward, *_ = envs.step(action.numpy())
    advantage = torch.as_tensor(reward - reward.mean(), dtype=torch.float32)
    optimizer.zero_grad()
    (-choice.log_prob(action) * advantage).mean().backward()
    optimizer.step()
