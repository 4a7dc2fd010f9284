# %% [markdown]
# # 2. Your own recording
#
# What would a policy have dropped of your robot's last drive? You need two things: a recording of what the robot sends,
# and a recording of a link. bufgym reads MCAP, ROS bags and CSV files. Here we write two small files in place of yours.

# %%
from pathlib import Path

import numpy as np

rng = np.random.default_rng(0)
time_s = np.arange(0, 30, 1 / 15)
rows = [f"{t:.3f},{size},camera" for t, size in zip(time_s, rng.integers(180_000, 260_000, len(time_s)), strict=True)]
rows += [f"{t:.3f},7328,scan" for t in np.arange(0.01, 30, 0.2)]
rows.sort(key=lambda row: float(row.split(",")[0]))
Path("drive.csv").write_text("time_s,bytes,topic\n" + "\n".join(rows) + "\n")

link = [f"{t},{5e6 * (0.5 + 0.5 * np.cos(t / 3)) ** 2:.0f}" for t in range(31)]
Path("uplink.csv").write_text("time_s,bytes_per_s\n" + "\n".join(link) + "\n")

# %% [markdown]
# ## Reading them
#
# The format is detected. A file that breaks a rule is refused, with file, line and rule.

# %%
from bufgym.traces import load, read_workload

recording = read_workload("drive.csv")
uplink = load("uplink.csv")
print(recording.topics, len(recording), "messages")
print(f"{uplink.mean_bytes_per_s / 1e6:.2f} MB/s on average")

# %% [markdown]
# ## What would it have dropped?
#
# The command is
#
# ```
# bufgym bench --workload drive.csv --trace uplink.csv --policies min-gap,afr,drop-oldest --drops dropped.csv
# ```
#
# Here it is called from Python. Its last table has the share of each topic that each policy dropped.

# %%
from bufgym.cli import main as bufgym_command

command = "bench --workload drive.csv --trace uplink.csv --policies min-gap,afr,drop-oldest --drops dropped.csv"
bufgym_command(command.split())
print(Path("dropped.csv").read_text().splitlines()[:3])

# %% [markdown]
# ## The picture
#
# `bufgym.compare` plays the same runs, and its result draws them.

# %%
import bufgym
from bufgym.model import qoi
from bufgym.scenario import Uplink

scenario = Uplink((uplink,), workload=recording, random_offset=False, value=qoi.exponential(0.618))
compared = bufgym.compare(["min-gap", "afr", "drop-oldest"], scenario, seeds=1, about="My drive over my link")
compared.plot().figure.savefig("own-recording.png")

# %% [markdown]
# ![The regret of each policy on the recording](own-recording.png)
