# %% [markdown]
# # 8. A fleet
#
# Many robots in one cell share its uplink: what one sends is missing for the others. `FleetEnv` is PettingZoo's
# interface; it needs the extra `fleet`.

# %%
from bufgym.envs import FleetEnv

env = FleetEnv(robots=4, capacity=8, duration_s=10.0, reward="team")
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
# `bufgym bench --suite fleet-v1` runs policies on 16 robots. Here are three of them on a cell of eight.

# %%
import bufgym
from bufgym.scenario import FleetScenario

cell = FleetScenario.of(8, "lte", duration_s=10.0)
names = ["learned", "afr", "drop-oldest"]
rows = bufgym.compare(names, cell, seeds=2).rows

# %% [markdown]
# ## The picture
#
# All policies met the same episodes, so each robot can be compared with itself: H minus its H under Drop Oldest. Each
# line is one robot in one episode.

# %%
import matplotlib.pyplot as plt

figure, axes = plt.subplots(figsize=(8, 3), layout="constrained")
h = {name: {(r["trace"], r["seed"], r["robot"]): r["qoi"] for r in rows if r["policy"] == name} for name in names}
for k, name in enumerate(names[:2]):
    gains = [h[name][robot] - h["drop-oldest"][robot] for robot in h[name]]
    axes.plot(gains, [k] * len(gains), "|", markersize=24)
    axes.text(sum(gains) / len(gains), k + 0.3, f"mean {sum(gains) / len(gains):.3f}", ha="center")
axes.axvline(0, color="gray", linewidth=0.8)
axes.set_yticks(range(2), names[:2])
axes.set_ylim(-0.5, 1.6)
axes.set_xlabel("H of a robot minus its H under Drop Oldest")
figure.savefig("fleet.png")

# %% [markdown]
# ![What each robot gains over Drop Oldest](fleet.png)
