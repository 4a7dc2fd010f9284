"""Optuna: a study over two settings of PPO, by the return of the last episodes."""

import optuna
from stable_baselines3 import PPO

from bufgym.sb3 import make_vec_env


def score(trial):
    envs = make_vec_env("bufgym/Uplink-v1", 16, capacity=8, duration_s=10.0, reward="regret")
    gamma, rate = trial.suggest_float("gamma", 0.8, 0.99), trial.suggest_float("rate", 1e-4, 3e-3, log=True)
    model = PPO("MlpPolicy", envs, n_steps=128, gamma=gamma, learning_rate=rate, device="cpu").learn(8_192)
    return float(sum(episode["r"] for episode in model.ep_info_buffer) / len(model.ep_info_buffer))


study = optuna.create_study(direction="maximize")
study.optimize(score, n_trials=2)
print(study.best_params)
