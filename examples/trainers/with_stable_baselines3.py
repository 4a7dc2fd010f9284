"""stable-baselines3: its PPO with its own defaults on the native batch."""

from stable_baselines3 import PPO

from bufgym.sb3 import make_vec_env

envs = make_vec_env("bufgym/Uplink-v1", 8, capacity=8, reward="regret")
PPO("MlpPolicy", envs, n_steps=256, device="cpu").learn(4_096)
