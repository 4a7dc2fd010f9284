# %% [markdown]
# # 7. Many topics
#
# A robot sends more than images: poses, scans, point clouds, its status. Robofleet's client schedules them by priority
# and rate limit. Two questions arise: what is dropped, and what is sent next?

# %%
from bufgym.scenario import get

client = get("topics", duration_s=20.0)
for topic in client.topics:
    print(f"{topic.name:15} priority {topic.priority:4g}  at most {topic.rate_limit_hz or 'any'} Hz")

# %% [markdown]
# ## Schedulers side by side
#
# A scheduler is a policy that also chooses what the free socket sends. H is the weighted sum over the topics.

# %%
import bufgym

names = ["gap-priority", "robofleet", "strict-priority", "fifo", "ros-native"]
rows = bufgym.compare(names, client, capacity=32, seeds=2).rows
for name in names:  # a row for each topic of a run; the run's weighted sum is in all of them
    h = [row["weighted_qoi"] for row in rows if row["policy"] == name and row["topic"] == client.topics[0].name]
    print(f"{name:18} H = {sum(h) / len(h):7.1f}")

# %% [markdown]
# The same on the command line, with your own client in TOML: `bufgym bench --scenario examples/client.toml`.
#
# ## Who is heard?
#
# The share of each topic's messages that reach the server shows how the schedulers differ.

# %%
import matplotlib.pyplot as plt
import numpy as np

topics = [topic.name for topic in client.topics]
figure, axes = plt.subplots(figsize=(8, 4), layout="constrained")
for k, name in enumerate(names):
    parts = [[row for row in rows if row["policy"] == name and row["topic"] == topic] for topic in topics]
    shares = [sum(r["delivered"] for r in part) / sum(r["arrived"] for r in part) for part in parts]
    axes.bar(np.arange(len(topics)) + 0.16 * (k - 2), shares, 0.16, label=name)
axes.set_xticks(range(len(topics)), topics, rotation=20)
axes.set_ylabel("share delivered")
axes.legend(fontsize=8)
figure.savefig("topics.png")

# %% [markdown]
# ![The share of each topic that reaches the server](topics.png)
