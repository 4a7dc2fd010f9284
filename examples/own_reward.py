"""Reward terms: bufgym's own terms with weights, and one of yours.

python examples/own_reward.py
"""

import argparse
from collections import Counter
from typing import Any

import gymnasium as gym

import bufgym  # noqa: F401  (registers the environments)
from bufgym.model.observe import reward_term


@reward_term("restless", unit="drops", memory={"drops": 0}, compile=True)
def restless(step: Any, memory: Any) -> float:
    """Minus the increase in drops since the previous step."""
    more = max(step.drops - memory[0], 0)
    memory[0] = step.drops
    return -float(more)


REWARD = {"retained": 1.0, "age": 0.1, "delay": 0.02, "energy": 0.01, "late:deadline_s=0.5": 0.2, "restless": 0.05}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=900, help="decisions in the environment")
    parser.add_argument("--seeds", type=int, default=1, help="how often to begin anew")
    options = parser.parse_args()

    env = gym.make("bufgym/Uplink-v1", reward=REWARD)
    for seed in range(options.seeds):
        _, info = env.reset(seed=seed)
        total, terms = 0.0, Counter[str]()
        for _ in range(options.steps):
            # Drop the message whose loss leaves the smallest gap.
            _, reward, ended, _, info = env.step(0)
            total += float(reward)
            for name, number in info["reward_terms"].items():
                terms[name] += number
            if ended:
                break
        print(f"reward {total:.2f} of", ", ".join(f"{name} {number:.2f}" for name, number in terms.items()))


if __name__ == "__main__":
    main()
