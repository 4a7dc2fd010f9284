# %% [markdown]
# # 5. stable-baselines3 to leaderboard
#
# A score says something when others can find it again. In this tutorial you train a model on the training split of a
# suite, run it on the test split with the command that everybody uses, and read its row. It needs the extras `train`
# and `plot`.
#
# ## Training on a suite
#
# A suite is frozen: its scenarios, capacities and episodes never change. `Suite-v1` draws from the split that you name;
# episodes of the test split do not occur in training.

# %%
from pathlib import Path

from stable_baselines3 import PPO

from bufgym.sb3 import make_vec_env

folder = Path("mine")
folder.mkdir(exist_ok=True)
envs = make_vec_env("bufgym/Suite-v1", 8, seed=0, suite="interruption-v1", split="train", capacity=10)
model = PPO("MlpPolicy", envs, n_steps=256, seed=0, device="cpu").learn(32_768)
model.save(folder / "my-agent.zip")

# %% [markdown]
# ## The test split
#
# `bufgym bench` takes the zip among its policies. In a shell you would type
#
# ```
# bufgym bench --suite interruption-v1 --policies mine/my-agent.zip,min-gap,afr,drop-oldest --out mine/rows
# ```
#
# Here the same is called from Python, with fewer episodes and one capacity to save time. Actions and observation are
# the same at every L, so the agent can be tested at an L that it never saw.

# %%
from bufgym.cli import main as bufgym

command = "bench --suite interruption-v1 --policies mine/my-agent.zip,min-gap,afr,drop-oldest --out mine/rows"
bufgym([*command.split(), "--seeds", "40", "--capacity", "20", "--jobs", "1", "--format", "csv"])

# %% [markdown]
# ## The row
#
# `mine/rows` holds a row for each episode and policy, and a manifest that says how they were made. A leaderboard entry
# sums them up, with an [interval](../guide/suites.md#intervals-and-shares) over episodes.

# %%
from bufgym.benchmark.leaderboard import of_folder

board = of_folder(folder / "rows")
board.sort(key=lambda entry: -entry.values["score"].value)
for entry in board:
    score = entry.values["score"]
    print(f"{entry.policy:12} {score.value:.3f} [{score.low:.3f}, {score.high:.3f}]")

# %% [markdown]
# After half a minute of training the agent is not above `min-gap` yet. `bufgym leaderboard` makes the site's table from
# such rows, and `bufgym validate` runs an entry again and compares.
#
# ## The picture

# %%
import matplotlib.pyplot as plt

figure, axes = plt.subplots(figsize=(7, 2.6), layout="constrained")
for k, entry in enumerate(reversed(board)):
    score = entry.values["score"]
    axes.barh(k, score.value, color="tab:orange" if entry.policy == "my-agent" else "lightgray")
    axes.plot([score.low, score.high], [k, k], color="black")
    axes.text(0.02, k, f"{score.value:.2f}", va="center")
axes.set_yticks(range(len(board)), [entry.policy for entry in reversed(board)])
axes.set_xlim(0, 1)
axes.set_xlabel("score in interruption-v1 at L = 20 (0: Drop Oldest, 1: the clairvoyant)")
figure.savefig("leaderboard.png")

# %% [markdown]
# ![Scores of the agent and of fixed policies](leaderboard.png)
