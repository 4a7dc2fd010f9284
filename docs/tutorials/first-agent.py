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

env = gym.make("bufgym/Interruption-v0", capacity=8, t_max=200, actions="slots")
observation, info = env.reset(seed=0)
print(env.action_space)  # evict slot 0..7, reject, accept
print(sorted(observation))

# %% [markdown]
# Every number in the observation lies in [0, 1]. The mask says which actions are valid now: the buffer is still empty,
# so nothing can be evicted.

# %%
print(info["action_mask"])

# %% [markdown]
# ## Training
#
# `make_vec_env` gives stable-baselines3 a native batch: one compiled step for all environments. `SlotPolicy` scores
# each queued message with one small network, so what it learns does not depend on L.

# %%
from sb3_contrib import MaskablePPO

from bufgym.sb3 import SlotPolicy, as_policy, make_vec_env

envs = make_vec_env("bufgym/Interruption-v0", 64, seed=0, capacity=8, t_max=200, actions="slots")
model = MaskablePPO(SlotPolicy, envs, n_steps=128, batch_size=2048, n_epochs=4, learning_rate=3e-3, gamma=1.0, seed=0)
model.learn(65_536)

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
# The agent is trained for seconds only. `make train` trains longer, and the [guide](../guide/training.md) says how the
# shipped agents were made.
#
# ## The picture

# %%
compared.plot().figure.savefig("first-agent.png")

# %% [markdown]
# ![The regret of the agent and of three other policies](first-agent.png)
