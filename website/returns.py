"""Returns of two rules in every environment, from which a learner's curve is read: the table on its page.

python -m website.returns

It writes ``website/returns.csv``, which the pages read.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from bufgym.envs import FleetVecEnv
from bufgym.envs.expert import policy
from website.environments import FLEET, HISTORY, RETURNS

RULES, EPISODES, ROBOTS = ("afr", "target-gap"), 100, 4


def played(envs: Any, rule: str) -> tuple[float, float]:
    """(Mean return, mean steps) of the first episode of each row under a rule."""
    envs.reset(seed=0)
    player = policy(envs, rule)
    returns, steps, over = np.zeros(envs.num_envs), np.zeros(envs.num_envs, np.int64), np.zeros(envs.num_envs, np.bool_)
    while not over.all():
        _, rewards, terminated, *_ = envs.step(player.actions())
        returns += np.where(over, 0.0, rewards)
        steps += ~over
        over |= terminated
    return float(returns.mean()), float(steps.mean())


def main() -> None:
    rows = []
    for id in HISTORY:
        for rule in RULES:
            options: dict[str, Any] = {"info": "mask"}
            cells = EPISODES // ROBOTS
            envs = FleetVecEnv(cells, ROBOTS, **options) if id == FLEET else gym.make_vec(id, EPISODES, **options)
            mean, steps = played(envs, rule)
            rows.append((id, rule, f"{mean:.2f}", f"{steps:.0f}"))
            print(*rows[-1], flush=True)
    with Path(RETURNS).open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([("id", "rule", "return", "steps"), *rows])


if __name__ == "__main__":
    main()
