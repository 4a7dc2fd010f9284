# %% [markdown]
# # 4. Your own scenario, field and reward
#
# The task is yours to change: what the sender meets, what the agent observes, and what it is rewarded for. Here a robot
# drives from hall to hall, and an operator wants its pictures soon rather than complete. Needs the extras `train` and
# `plot`.
#
# ## A scenario
#
# A scenario has a V, a longest episode, and a `draw` that makes an episode from random streams.

# %%
from dataclasses import dataclass, field

import numpy as np

from bufgym import scenario
from bufgym.model import Link, qoi
from bufgym.traces import Trace


@scenario.register("between-halls", "a robot drives from hall to hall; between them its link is slow")
@dataclass(frozen=True)
class BetweenHalls:
    rate_hz: float = 30.0
    duration_s: float = 20.0
    slow_bytes_per_s: float = 1e6
    value: qoi.Value = field(default_factory=qoi.exponential)
    topics = ()  # one queue

    @property
    def max_messages(self):
        return round(self.rate_hz * self.duration_s)

    def draw(self, streams):
        arrival_us = (np.arange(self.max_messages) * 1e6 / self.rate_hz).astype(np.int64)
        stays_s = streams.link.uniform(2, 6, size=10).tolist()
        steps = [(stay_s, 9e6 if k % 2 else self.slow_bytes_per_s) for k, stay_s in enumerate(stays_s)]
        return scenario.Episode(scenario.messages(arrival_us, 230_000), Link(Trace.steps(steps)))


# %% [markdown]
# ## A field
#
# A field is a function of the buffer and the arrival. This one is computed for each message; the newcomer is
# `k = len(buffer.slots)`. `compile=True` promises that it can become C.

# %%
from bufgym.model.observe import field as observed
from bufgym.model.observe import reward_term


@observed("staleness", per="slot", compile=True)
def staleness(buffer, arrival, k):
    "s / (s + 1), where the message has been in the buffer for s seconds."
    if k == len(buffer.slots):
        return 0.0
    waited_s = (buffer.now_us - buffer.slots[k].arrival_us) / 1e6
    return waited_s / (waited_s + 1)


# %% [markdown]
# ## A reward
#
# A term is a function of what happened in a step. This one counts how old messages are when they reach the server.


# %%
@reward_term("waited", unit="s", compile=True)
def waited(step, memory):
    "Minus the seconds from a message's arrival to the server, summed over the messages of this step."
    total_us = 0
    for m in step.delivered:
        total_us += step.log[m].transmitted_us + step.propagation_us - step.messages[m].arrival_us
    return -total_us / 1e6


# %% [markdown]
# Both are used by their names. `reward` weighs terms: `retained` is the QoI that a decision costs or gains.

# %%
import gymnasium as gym

import bufgym

task = {"scenario": "between-halls", "capacity": 8}
task["fields"] = ["occupied", "rank", "loss", "staleness", "occupancy", "busy", "left", "service_ratio"]
env = gym.make("bufgym/Uplink-v1", reward={"retained": 1.0, "waited": 5.0}, **task, actions="slots")
env.reset(seed=0)
_, reward, _, _, info = env.step(env.action_space.n - 1)  # accept
print(reward, info["reward_terms"])

# %% [markdown]
# ## Two agents
#
# They differ in the weight of `waited` alone. The first is asked for QoI, the second for QoI and haste.

# %%
from sb3_contrib import MaskablePPO

from bufgym.sb3 import SlotPolicy, make_vec_env


def train(weight):
    envs = make_vec_env(
        "bufgym/Uplink-v1", 64, seed=0, reward={"retained": 1.0, "waited": weight}, **task, actions="slots"
    )
    settings = {"n_steps": 64, "batch_size": 1024, "n_epochs": 4, "learning_rate": 3e-3, "gamma": 0.95}
    return MaskablePPO(SlotPolicy, envs, seed=0, **settings).learn(81_920)


agents = {"complete": train(0.0), "soon": train(5.0)}

# %% [markdown]
# ## The picture
#
# All play the same 20 episodes, with fixed policies as experts. Each point is a policy: how much the server saw, and
# how long a message took. `reward_terms` report `waited` for all of them; with a weight of 0 it does not count.

# %%
import matplotlib.pyplot as plt

from bufgym.envs import expert

envs = gym.make_vec("bufgym/Uplink-v1", 20, reward={"retained": 1.0, "waited": 0.0}, **task, actions="slots")
figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
for name in (*agents, "min-gap", "afr", "drop-oldest"):
    observation, info = envs.reset(seed=100)
    waited_s = 0.0
    player = None if name in agents else expert.policy(envs, name)
    for _ in range(BetweenHalls().max_messages):  # a decision for each
        masks = info["action_mask"].astype(bool)
        if player is None:
            actions, _ = agents[name].predict(observation, deterministic=True, action_masks=masks)
        else:
            actions = player.actions()
        observation, _, _, _, info = envs.step(actions)
        waited_s -= info["reward_terms"]["waited"].sum()
    delay_s, h = waited_s / info["delivered"].sum(), info["qoi"].mean()
    print(f"{name:12} H = {h:.1f}, {delay_s:.2f} s")
    axes.plot(delay_s, h, "o", markersize=9, color="tab:red" if name in agents else "tab:gray")
    side = 9 if name in agents else -17  # points; agents are named above, the others below
    axes.annotate(name, (delay_s, h), xytext=(0, side), textcoords="offset points", ha="center")
axes.margins(0.15, 0.25)
axes.set_xlabel("mean time from arrival to server (s)")
axes.set_ylabel("QoI (H)")
figure.savefig("own-task.png")

# %% [markdown]
# ![QoI and delay of two agents and three fixed policies](own-task.png)
