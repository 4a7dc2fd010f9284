"""d3rlpy and Minari, offline: ``bufgym dataset make`` writes a data set, and d3rlpy learns from it."""

import d3rlpy
import minari
import numpy as np

from bufgym.cli import main

options = ["--option", "duration_s=5.0"]
main(["dataset", "make", "--kind", "mixed", "--episodes", "5", *options, "--out", "data"])
played = list(minari.load_dataset("bufgym/uplink/mixed-v0"))
observations = np.concatenate([episode.observations[:-1] for episode in played])
actions, rewards = (np.concatenate([getattr(e, name) for e in played])[:, None] for name in ("actions", "rewards"))
ends = np.concatenate([episode.terminations | episode.truncations for episode in played]).astype(np.float32)
data = d3rlpy.dataset.MDPDataset(observations, actions, rewards.astype(np.float32), ends)
cql = d3rlpy.algos.DiscreteCQLConfig(gamma=0.9).create(device="cpu")
cql.fit(data, n_steps=200, n_steps_per_epoch=100, show_progress=False)
