"""Imitating the clairvoyant by DAgger: a slot network learns decisions made in hindsight, and plays without it.

    pip install ".[train]"
    python examples/imitation.py

It trains on six of the eight shipped links and is tested on the other two, on the episodes of

    bufgym bench --trace lte-synthetic-6 lte-synthetic-7 --seeds 40 --policies afr,min-motion-gap,drop-oldest

In DAgger (Ross, Gordon and Bagnell 2011) the network plays a batch of episodes, the clairvoyant labels every state
visited, and the network learns from all states so far. Two points are special here.

- **A label is a number for each action**: the H that it loses for good, from ``bufgym.envs.expert``. Most decisions
  are close, so the network learns probabilities, softmax(-regret / temperature). A close second costs little.
- **Hindsight knows the future.** Where the link decides later which action was right, labels of equal states disagree
  and the network learns their mean. That is worth more than AFR, but even a perfect pupil would not reach a score of 1.
"""

import argparse
import time
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch

import bufgym
from bufgym import policies, scenario
from bufgym.envs import expert
from bufgym.oracle import normalised_score
from bufgym.sb3 import SlotPolicy, as_policy

TRAIN = [f"lte-synthetic-{k}" for k in range(6)]
TEST = ["lte-synthetic-6", "lte-synthetic-7"]
RIVALS = ("min-motion-gap", "afr", "drop-oldest")


@dataclass
class Settings:
    """Arguments of ``main`` and options of the command line."""

    seed: int = 0
    capacity: int = 8
    """L, messages."""
    rounds: int = 6
    """Number of rounds in which the network plays."""
    episodes: int = 128
    """Episodes played in parallel in each round."""
    duration_s: float = 10.0
    """Length of a training episode."""
    test_duration_s: float = 30.0
    test_seeds: int = 40
    """Test episodes on each held-out link."""
    epochs: int = 2
    """Passes over all states so far, after each round."""
    minibatch: int = 2_048
    """States of one gradient step."""
    learning_rate: float = 2e-3
    """Learning rate in the first round; it falls linearly to 0."""
    temperature: float = 0.02
    """Difference in lost QoI that makes an action e times less likely."""
    width: int = 32
    """Hidden units a layer."""


States = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Rows of observed numbers, masks, and the regret of every action."""


class Pupil:
    """A slot network, and the batch that it plays."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.envs: Any = gym.make_vec(
            "bufgym/Uplink-v1",
            settings.episodes,
            capacity=settings.capacity,
            traces=TRAIN,
            duration_s=settings.duration_s,
            info="mask",
            autoreset_mode=gym.vector.AutoresetMode.SAME_STEP,
            actions="slots",
        )
        self.envs.reset(seed=settings.seed)
        self.sub_envs = self.envs.unwrapped.sub_envs
        self.judge = expert.clairvoyant(self.envs)
        self.rng = np.random.default_rng(settings.seed)
        spaces = self.envs.single_observation_space, self.envs.single_action_space
        self.network = SlotPolicy(*spaces, lambda _: settings.learning_rate, width=settings.width)

    def log_p(self, seen: np.ndarray, mask: np.ndarray) -> torch.Tensor:
        """Log-probability of each action, [n, L + 2]; invalid actions have probability 0."""
        observation = {name: torch.from_numpy(array) for name, array in self.sub_envs.form.of(seen).items()}
        return self.network.get_distribution(observation, mask).distribution.logits

    def play(self, first: bool) -> States:
        """Play an episode in each row; ``first`` plays half of them by the clairvoyant and half at random."""
        states = []
        for _ in range(self.sub_envs.scenario.max_messages):
            output = self.sub_envs.output
            seen, mask, regrets = output.flat.copy(), output.action_mask.copy(), self.judge.regrets()
            if first:
                drawn = np.argmax(self.rng.random(mask.shape) * mask, axis=1)
                actions = np.where(np.arange(len(mask)) % 2, np.nanargmin(regrets, axis=1), drawn)
            else:
                with torch.no_grad():
                    actions = self.log_p(seen, mask).argmax(dim=1).numpy()
            states.append((seen, mask, np.nan_to_num(regrets).astype(np.float32)))
            self.envs.step(actions)
        seen, mask, regrets = (np.concatenate(part) for part in zip(*states, strict=True))
        return seen, mask, regrets

    def learn(self, states: States, learning_rate: float) -> float:
        """Train on ``states``; return the mean regret of the network's probabilities in the last pass."""
        settings, optimizer = self.settings, self.network.optimizer
        optimizer.param_groups[0]["lr"] = learning_rate
        expected = []
        for epoch in range(settings.epochs):
            for batch in torch.randperm(len(states[0])).split(settings.minibatch):
                seen, mask, regrets = (part[batch.numpy()] for part in states)
                given_away = torch.from_numpy(regrets)
                log_p = self.log_p(seen, mask)
                target = (-given_away / settings.temperature).masked_fill(torch.from_numpy(mask == 0), -1e9).softmax(1)
                loss = -(target * log_p).sum(1).mean()
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
                if epoch == settings.epochs - 1:
                    expected.append((log_p.detach().exp() * given_away).sum(1))
        return float(torch.cat(expected).mean())


def scores(network: SlotPolicy, settings: Settings) -> dict[str, float]:
    """Score policies on the held-out links, from 0 for Drop Oldest to 1 for the clairvoyant."""
    uplink = scenario.get("lte", traces=TEST, duration_s=settings.test_duration_s)
    players = [as_policy(network, "imitation"), *map(policies.get, RIVALS)]
    rows = bufgym.compare(players, uplink, capacity=settings.capacity, seeds=settings.test_seeds).rows
    h = {player.name: sum(row["qoi"] for row in rows if row["policy"] == player.name) for player in players}
    best = sum(row["clairvoyant"] for row in rows if row["policy"] == "drop-oldest")
    return {name: float(normalised_score(total, h["drop-oldest"], best)) for name, total in h.items()}


def main(settings: Settings) -> dict[str, float]:
    """Train and test; return the scores by policy."""
    torch.manual_seed(settings.seed)
    torch.set_num_threads(1)
    pupil, seen, began = Pupil(settings), [], time.process_time()
    for k in range(settings.rounds):
        seen.append(pupil.play(first=k == 0))
        states = [np.concatenate(part) for part in zip(*seen, strict=True)]
        regret = pupil.learn(tuple(states), settings.learning_rate * (1 - k / settings.rounds))
        spent_s = time.process_time() - began
        print(f"round {k + 1}: {len(states[0]):,} states, regret of a decision {regret:.4f}, {spent_s:.0f} CPU seconds")
    reached = scores(pupil.network, settings)
    for name, score in reached.items():
        print(f"score of {name}: {score:.3f}")
    return reached


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in vars(Settings()).items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(default), default=default, help="(%(default)s)")
    main(Settings(**vars(parser.parse_args())))
