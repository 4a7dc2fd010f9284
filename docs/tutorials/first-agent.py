# %% [markdown]
# # 1. Your first agent
#
# In this tutorial you train an agent that decides what to drop, compare it with fixed policies, and look at what the
# server sees. It needs the extras `train` and `plot`; `make train` has set up both.
#
# ## The environment
#
# A camera sends 30 images a second. The link stops for T images, and nobody knows T. The buffer holds L = 8.

# %%
import gymnasium as gym

import bufgym

env = gym.make("bufgym/Interruption-v1", capacity=8, t_max=200)
observation, info = env.reset(seed=2)
print(env.action_space)  # drop the cheapest candidate, the second cheapest, or the head
print(observation.shape)

# %% [markdown]
# You are asked when the buffer is full. A candidate is a message that could go, and the cheapest is the one whose loss
# leaves the smallest gap. `info["slots"]` says which messages the three actions mean: 0 is the oldest in the queue, 8
# the newcomer.

# %%
print(info["slots"])

# %% [markdown]
# ## Training
#
# `make_vec_env` gives stable-baselines3 a native batch: one compiled step for all environments. PPO keeps its defaults,
# except for shorter rollouts, since 8 environments play at once.

# %%
from stable_baselines3 import PPO

from bufgym.sb3 import as_policy, make_vec_env

envs = make_vec_env("bufgym/Interruption-v1", 8, seed=0, capacity=8, t_max=200)
model = PPO("MlpPolicy", envs, n_steps=256, seed=0, device="cpu")
model.learn(32_768)

# %% [markdown]
# ## Comparing
#
# `as_policy` makes the model a policy like any other. All policies meet the same episodes.

# %%
from bufgym.scenario import Interruption

mine = as_policy(model, "my-agent")
compared = bufgym.compare([mine, "learned", "afr", "drop-oldest"], Interruption(t_max=200), seeds=20)
print(compared)

# %% [markdown]
# The agent is trained for seconds only. [Training](../guide/training.md) goes on from here.
#
# ## The picture

# %%
compared.plot().figure.savefig("first-agent.png")

# %% [markdown]
# ![The regret of the agent and of three other policies](first-agent.png)
