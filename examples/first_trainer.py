"""Your first trainer: stable-baselines3's PPO with its defaults, compared with the best rule.

    pip install ".[train]"
    python examples/first_trainer.py

The reward ``regret`` knows the link's future. The observation does not, and the comparison does not use the reward.
"""

import argparse

import torch
from stable_baselines3 import PPO

import bufgym
from bufgym.sb3 import as_policy, make_vec_env


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=50_000, help="decisions to learn from (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the training (%(default)s)")
    parser.add_argument("--seeds", type=int, default=5, help="episodes of the comparison on each link (%(default)s)")
    options = parser.parse_args()

    torch.set_num_threads(1)  # more only wait for one another on a network this small
    envs = make_vec_env("bufgym/Uplink-v1", reward="regret")
    model = PPO("MlpPolicy", envs, seed=options.seed, device="cpu").learn(options.steps)

    mine = as_policy(model, "mine")
    print(bufgym.compare([mine, "target-gap", "afr", "drop-oldest"], "lte", capacity=8, seeds=options.seeds))


if __name__ == "__main__":
    main()
