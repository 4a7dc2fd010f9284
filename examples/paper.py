"""A paper's worth: a scenario, a reward and a rule of your own, two agents with three seeds each, a table and a figure.

    python examples/paper.py    # writes runs/paper: table.tex, estimates.csv, curves.svg; the same command resumes it

Each agent learns on the suite's training split, and every policy meets the episodes of its test split.
"""

import argparse
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path

from stable_baselines3 import DQN, PPO

import bufgym
from bufgym.model.observe import reward_term
from bufgym.sb3 import as_policy, make_vec_env
from bufgym.scenario import get
from bufgym.traces import Trace

TRAINERS = {"ppo": PPO, "dqn": DQN}
LINKS = tuple(Trace.steps([(stay, 6e6), (4.0, 2e5)], name=f"hall-{stay}") for stay in (2.0, 3.0, 4.0, 5.0))
HALLS = get("lte", traces=LINKS, rate_hz=10.0, size_bytes=300_000)
LAB = bufgym.suite("halls-v1", HALLS, capacity=8, seeds=20, about="A robot drives from hall to hall, slow between them")
REWARD = {"cost": 1.0, "restless": 0.01}


@reward_term("restless", unit="drops", compile=True)
def restless(step, memory):
    """Minus the drops of this step."""
    return -float(step.drops)


def every_second(buffer, arrival, memory):
    """Keeps each second message and drops the oldest for it."""
    return -1 if arrival.seq % 2 else -2 if len(buffer.slots) < buffer.capacity else 0


def train(agent, steps, out):
    name, seed = agent
    folder = out / name / f"seed-{seed}"
    if (folder / "model.zip").exists():
        return
    world = {"suite": LAB.name, "split": "train", "reward": REWARD}
    envs = make_vec_env("bufgym/Suite-v1", seed=1000 * seed, monitor_dir=str(folder), **world)
    TRAINERS[name]("MlpPolicy", envs, seed=seed, device="cpu").learn(steps).save(folder / "model.zip")
    envs.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=50_000, help="of each agent (%(default)s)")
    parser.add_argument("--episodes", type=int, default=20, help="on each link (%(default)s)")
    parser.add_argument("--out", type=Path, default=Path("runs/paper"))
    options = parser.parse_args()

    agents = [(name, seed) for name in TRAINERS for seed in range(3)]
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:  # two cores
        list(pool.map(partial(train, steps=options.steps, out=options.out), agents))
    models = [as_policy(options.out / n / f"seed-{s}" / "model.zip", f"{n}-{s}") for n, s in agents]
    rules = [every_second, "target-gap", "afr"]
    done = bufgym.compare([*models, *rules], LAB, seeds=options.episodes, out=options.out / "test")
    print(done)
    (options.out / "table.tex").write_text(done.table("latex"))
    done.write_estimates(options.out / "estimates.csv")
    bufgym.curves([options.out / name for name in TRAINERS], options.out / "curves.svg")
