# %% [markdown]
# # 8. A fleet
#
# Many robots in one cell share its uplink: what one sends is missing for the others. `parallel_env` is PettingZoo's
# interface; it needs the extra `fleet`.

# %%
from bufgym.envs import parallel_env

env = parallel_env(robots=4, capacity=8, duration_s=10.0, reward="team")
observations, infos = env.reset(seed=0)
print(env.agents)

# %% [markdown]
# ## A loop
#
# All robots decide at the same frame tick. Here each draws a valid action at random.

# %%
for i, agent in enumerate(env.agents):
    env.action_space(agent).seed(i)
while env.agents:
    actions = {agent: env.action_space(agent).sample(infos[agent]["action_mask"]) for agent in env.agents}
    observations, rewards, _, _, infos = env.step(actions)
print({agent: round(info["qoi"], 2) for agent, info in infos.items()})

# %% [markdown]
# ## Policies on every robot
#
# `bufgym fleet --suite fleet-v1` runs policies on 16 robots. Here are three of them on a cell of eight.

# %%
from bufgym import policies
from bufgym.benchmark import run
from bufgym.scenario import FleetScenario

cell = FleetScenario.of(8, "lte", duration_s=10.0)
names = ["learned-motion", "afr", "drop-oldest"]
rows = run.run([policies.get(name) for name in names], cell, capacities=[8], seeds=2)

# %% [markdown]
# ## The picture
#
# Each point is one robot in one episode.

# %%
import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt

figure, axes = plt.subplots(figsize=(8, 3), layout="constrained")
for k, name in enumerate(names):
    h = [row["qoi"] for row in rows if row["policy"] == name]
    axes.plot(h, [k] * len(h), "|", markersize=18)
axes.set_yticks(range(len(names)), names)
axes.set_ylim(-0.6, len(names) - 0.4)
axes.set_xlabel("H of a robot in an episode")
figure.savefig("fleet.png")

# %% [markdown]
# ![H of each robot under three policies](fleet.png)
