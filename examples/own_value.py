"""A V of your own, the information that a message adds at a distance d from the one before it.

python examples/own_value.py
cd examples && bufgym bench --value own_value:doorways --policies min-motion-gap,afr,drop-oldest
"""

import argparse

import gymnasium as gym

import bufgym
from bufgym import scenario


def doorways(d: float) -> float:
    """Half of the view is new after a tenth of a field of view."""
    return d / (d + 0.1)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=900, help="decisions in the environment")
    parser.add_argument("--seeds", type=int, default=2, help="episodes of the benchmark on each link")
    options = parser.parse_args()

    v = scenario.get("lte", value=doorways).value  # checked here: V(0) = 0, rising, at most 1, concave
    print(f"V(0.1) = {v(0.1):.3f}, V(1) = {v(1.0):.3f}")

    # As text it stands in YAML files and env.spec.to_json() as well; value=doorways does the same.
    env = gym.make("bufgym/Uplink-v1", value="own_value:doorways")
    _, info = env.reset(seed=0)
    for _ in range(options.steps):
        _, _, ended, _, info = env.step(env.action_space.sample())
        if ended:
            print(f"at random: {info['delivered']} of {info['arrived']} delivered, QoI {info['qoi']:.1f}")
            _, info = env.reset()

    test = scenario.get("lte", value="own_value:doorways", duration_s=10.0)
    print(bufgym.compare(["min-motion-gap", "afr", "drop-oldest"], test, seeds=options.seeds).table())


if __name__ == "__main__":
    main()
