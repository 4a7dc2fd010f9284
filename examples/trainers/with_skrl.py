"""skrl: its PPO. ``headless`` is needed, as a batch does not draw."""

import gymnasium as gym
from skrl.envs.wrappers.torch import wrap_env
from skrl.utils.runner.torch import Runner

import bufgym  # noqa: F401  (registers the environments)

envs = wrap_env(gym.make_vec("bufgym/Uplink-v1", num_envs=8, capacity=8, reward="regret"))
part = {
    "class": "CategoricalMixin",
    "network": [{"name": "net", "input": "OBSERVATIONS", "layers": [64], "activations": "tanh"}],
}
models = {
    "separate": True,
    "policy": part | {"output": "ACTIONS", "unnormalized_log_prob": True},
    "value": part | {"class": "DeterministicMixin", "output": "ONE"},
}
agent = {"class": "PPO", "rollouts": 32, "learning_epochs": 2, "mini_batches": 4}
cfg = {"seed": 0, "models": models, "memory": {"class": "RandomMemory", "memory_size": -1}, "agent": agent}
cfg["trainer"] = {"class": "SequentialTrainer", "timesteps": 64, "headless": True, "environment_info": "log"}
Runner(envs, cfg).run("train")
