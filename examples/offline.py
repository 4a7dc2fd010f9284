"""Offline learning of a policy from a data set, by behaviour cloning and by d3rlpy's conservative Q-learning.

    pip install ".[offline]"
    python examples/offline.py --kinds medium mixed

It reads data sets of ``bufgym dataset make``, and makes missing ones in ``--data``. Both learners train the same slot
network on six of the eight shipped links and never touch an environment; they are tested on the other two links, on the
episodes of

    bufgym bench --trace lte-synthetic-6 lte-synthetic-7 --seeds 40 --policies afr,min-motion-gap,drop-oldest

CQL (Kumar et al. 2020) is Q-learning on recorded steps that also pushes down the values of actions that nobody took.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from dataclasses import dataclass, field
from pathlib import Path

import d3rlpy
import gymnasium as gym
import minari
import numpy as np
import torch
from d3rlpy.dataset import TransitionMiniBatch
from d3rlpy.models.q_functions import QFunctionFactory
from d3rlpy.models.torch.q_functions import DiscreteMeanQFunctionForwarder, DiscreteQFunction, QFunctionOutput
from gymnasium import spaces
from gymnasium.spaces.utils import flatdim
from torch import Tensor

import bufgym
from bufgym import policies, scenario
from bufgym.cli import main as run_bufgym
from bufgym.oracle import normalised_score
from bufgym.sb3 import SlotPolicy, as_policy

TRAIN = [f"lte-synthetic-{k}" for k in range(6)]
TEST = ["lte-synthetic-6", "lte-synthetic-7"]
RIVALS = ("min-motion-gap", "afr", "drop-oldest")
L = 8
FIELDS = gym.make("bufgym/Uplink-v1", capacity=L, actions="slots", observation="dict").observation_space
"""Fields of an observation. A data set has them flat, one behind the other."""


@dataclass
class Settings:
    """Arguments of ``main`` and options of the command line."""

    kinds: list[str] = field(default_factory=lambda: ["medium", "mixed"])
    """Kinds of data sets, named after their players."""
    data: str = "offline-data"
    """Folder of the data sets."""
    episodes: int = 300
    """Episodes of each data set."""
    duration_s: float = 10.0
    test_duration_s: float = 30.0
    test_seeds: int = 40
    """Test episodes on each held-out link."""
    updates: int = 1_000
    """Gradient steps of each learner."""
    minibatch: int = 1_024
    learning_rate: float = 2e-3
    gamma: float = 0.9
    """The reward pays at once what a decision costs, so a short sight keeps noise out."""
    alpha: float = 1.0
    """CQL's weight of the penalty on unseen actions."""
    reward_scale: float = 10.0
    """Rewards are hundredths of QoI; Q-learning likes them larger."""
    seed: int = 0


@dataclass
class Steps:
    """A data set as arrays, a row for each step."""

    seen: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    seen_next: np.ndarray
    ended: np.ndarray


def read(kind: str, settings: Settings) -> Steps:
    """Read the data set of that kind; make it first if it is missing."""
    name, folder = f"bufgym/uplink/{kind}-v0", Path(settings.data)
    if not (folder / name).exists():
        options = {"duration_s": settings.duration_s, "traces": TRAIN, "actions": "slots", "observation": "flat"}
        command = f"dataset make --kind {kind} --episodes {settings.episodes} --capacity {L} --seed {settings.seed}"
        further = [part for key, value in options.items() for part in ("--option", f"{key}={json.dumps(value)}")]
        if code := run_bufgym([*command.split(), "--no-regret", *further, "--out", str(folder)]):
            raise SystemExit(code)
    os.environ["MINARI_DATASETS_PATH"] = str(folder.absolute())
    parts = [
        (e.observations[:-1], e.actions, e.rewards, e.observations[1:], e.terminations)
        for e in minari.load_dataset(name)
    ]
    return Steps(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def new_network(settings: Settings) -> SlotPolicy:
    """An untrained slot network."""
    return SlotPolicy(FIELDS, spaces.Discrete(L + 2), lambda _: settings.learning_rate)


def scored(network: SlotPolicy, seen: Tensor) -> Tensor:
    """Network's number for each action, [n, L + 2], very low for an invalid action."""
    observation = dict(zip(FIELDS, seen.split([flatdim(space) for space in FIELDS.values()], dim=1), strict=True))
    features = network.extract_features(observation)
    full = observation["occupied"][:, :L].min(dim=1, keepdim=True).values
    valid = torch.cat([observation["occupied"][:, :L], torch.ones_like(full), 1 - full], dim=1)
    return network.mlp_extractor.forward_actor(features).masked_fill(valid == 0, -1e6)


def batches(steps: Steps, settings: Settings) -> list[np.ndarray]:
    """Draw random minibatches as indices."""
    rng = np.random.default_rng(settings.seed)
    return [rng.integers(len(steps.action), size=settings.minibatch) for _ in range(settings.updates)]


def clone(steps: Steps, settings: Settings) -> SlotPolicy:
    """Behaviour cloning: the recorded actions become likely."""
    network = new_network(settings)
    for k, batch in enumerate(batches(steps, settings)):
        network.optimizer.param_groups[0]["lr"] = settings.learning_rate * (1 - k / settings.updates)
        logits, taken = scored(network, torch.from_numpy(steps.seen[batch])), torch.from_numpy(steps.action[batch])
        loss = torch.nn.functional.cross_entropy(logits, taken)
        network.optimizer.zero_grad()
        loss.backward()
        network.optimizer.step()
    return network


class SlotQ(DiscreteQFunction):
    """Q of each action from a slot network; invalid ones are never the best."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        self.network = new_network(settings)

    def forward(self, x: Tensor) -> QFunctionOutput:
        return QFunctionOutput(q_value=scored(self.network, x), quantiles=None, taus=None)

    @property
    def encoder(self) -> SlotPolicy:
        return self.network


@dataclass
class SlotQFactory(QFunctionFactory):
    """Makes ``SlotQ`` for d3rlpy."""

    settings: Settings = field(default_factory=Settings)

    def create_discrete(
        self, encoder: object, hidden_size: int, action_size: int
    ) -> tuple[SlotQ, DiscreteMeanQFunctionForwarder]:
        q = SlotQ(self.settings)
        return q, DiscreteMeanQFunctionForwarder(q, action_size)

    @staticmethod
    def get_type() -> str:
        return "slots"


def conservative(steps: Steps, settings: Settings) -> SlotPolicy:
    """Discrete CQL: the network's numbers become values, pushed down where the data set has nothing."""
    cql = d3rlpy.algos.DiscreteCQLConfig(
        batch_size=settings.minibatch,
        gamma=settings.gamma,
        learning_rate=settings.learning_rate,
        q_func_factory=SlotQFactory(settings=settings),
        target_update_interval=50,
        alpha=settings.alpha,
        reward_scaler=d3rlpy.preprocessing.MultiplyRewardScaler(settings.reward_scale),
    ).create(device="cpu:0")
    cql.create_impl((flatdim(FIELDS),), L + 2)
    for batch in batches(steps, settings):
        column = {name: part[batch, None].astype(np.float32) for name, part in vars(steps).items() if part.ndim == 1}
        drawn = TransitionMiniBatch(
            observations=steps.seen[batch],
            actions=column["action"],
            rewards=column["reward"],
            next_observations=steps.seen_next[batch],
            next_actions=np.zeros_like(column["action"]),  # no part in Q-learning
            terminals=column["ended"],
            intervals=np.ones_like(column["ended"]),
            transitions=[],
        )
        cql.update(drawn)
    assert cql.impl is not None
    return cql.impl.q_function[0].encoder


def main(settings: Settings) -> dict[str, float]:
    """Learn from each data set and test; return scores by learner and data set, and of fixed policies."""
    torch.set_num_threads(1)
    players = [policies.get(name) for name in RIVALS]
    for kind in settings.kinds:
        steps = read(kind, settings)
        for name, learn in (("cloning", clone), ("cql", conservative)):
            d3rlpy.seed(settings.seed)
            began = time.process_time()
            players.append(as_policy(learn(steps, settings), f"{name}-{kind}"))
            print(f"{name} of {len(steps.action):,} {kind} steps: {time.process_time() - began:.0f} CPU seconds")
    held_out = scenario.get("lte", traces=TEST, duration_s=settings.test_duration_s)
    rows = bufgym.compare(players, held_out, capacity=L, seeds=settings.test_seeds).rows
    h = {player.name: sum(row["qoi"] for row in rows if row["policy"] == player.name) for player in players}
    best = sum(row["clairvoyant"] for row in rows if row["policy"] == "drop-oldest")
    reached = {name: float(normalised_score(total, h["drop-oldest"], best)) for name, total in h.items()}
    for name, score in sorted(reached.items(), key=lambda pair: -pair[1]):
        print(f"score of {name}: {score:.3f}")
    return reached


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in vars(Settings()).items():
        kind = {"nargs": "+", "type": str} if isinstance(default, list) else {"type": type(default)}
        parser.add_argument(f"--{name.replace('_', '-')}", default=default, help="(%(default)s)", **kind)
    main(Settings(**vars(parser.parse_args())))
