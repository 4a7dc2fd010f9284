"""From stable-baselines3 to a row of the leaderboard: train on a suite's train split, run its test split, read the row.

    pip install ".[train]"
    python examples/sb3_to_leaderboard.py --suite lte-v1 --steps 500000 --out mine

The second half is what anybody does with a model of their own:

    bufgym bench --suite lte-v1 --policies mine/model.zip,afr,drop-oldest --out mine/rows
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from stable_baselines3 import PPO

from bufgym.benchmark.leaderboard import of_folder, write
from bufgym.cli import main as bufgym
from bufgym.sb3 import make_vec_env


def train(suite: str, capacity: int, steps: int, num_envs: int, path: Path) -> None:
    """PPO with its defaults but for shorter rollouts; the agent serves every L. The model is a zip."""
    envs = make_vec_env(
        "bufgym/Suite-v1", num_envs, seed=0, suite=suite, split="train", capacity=capacity, reward="regret"
    )
    PPO("MlpPolicy", envs, n_steps=256, device="cpu", seed=0).learn(steps).save(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--suite", default="lte-v1", help="of one queue and equal sizes, without recordings (%(default)s)"
    )
    parser.add_argument("--capacity", type=int, default=10, help="L to learn at (%(default)s)")
    parser.add_argument("--steps", type=int, default=500_000, help="decisions to learn from (%(default)s)")
    parser.add_argument("--num-envs", type=int, default=8, help="environments side by side (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("mine"), help="folder of the model and its rows (%(default)s)")
    parser.add_argument("bench", nargs="*", metavar="-- --seeds N", help="more options of bufgym bench")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    model = options.out / "model.zip"
    train(options.suite, options.capacity, options.steps, options.num_envs, model)
    rows = options.out / "rows"
    chosen = ["--policies", f"{model},afr,drop-oldest", "--format", "csv", "--out", str(rows)]
    if code := bufgym(["bench", "--suite", options.suite, *chosen, *options.bench]):
        raise SystemExit(code)
    board = of_folder(rows)
    # By its file, as the command in the row names it.
    board = [replace(entry, policy=str(model)) if entry.policy == model.stem else entry for entry in board]
    write(board, options.out / "leaderboard.csv")
    print((options.out / "leaderboard.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
