"""sbx, stable-baselines3 in JAX: its PPO on the native batch."""

from sbx import PPO

from bufgym.sb3 import make_vec_env

envs = make_vec_env("bufgym/Uplink-v1", 8, capacity=8, reward="regret")
PPO("MlpPolicy", envs, n_steps=256).learn(4_096)
