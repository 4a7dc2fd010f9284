"""Imitating the clairvoyant by DAgger: a small network learns what hindsight would have done, and plays without it.

    python examples/imitation.py --rounds 6

Each round the network plays a batch of episodes, the clairvoyant says for every state what each action would have given
away (``bufgym.expert``), and the network learns to give away little in expectation: cheap mistakes cost little.
Needs torch (extra ``train``).
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from torch import nn

from bufgym import expert, policies
from bufgym.envs import SenderVectorEnv
from bufgym.oracle import clairvoyant
from bufgym.oracle.measure import normalised_score
from bufgym.scenario import Episode
from bufgym.sim import run
from bufgym.sim.metrics import outcome

TASK = {"capacity": 8, "duration_s": 10.0, "size_bytes": 500_000, "observation": "flat", "info": "none"}


def network(envs: SenderVectorEnv) -> nn.Sequential:
    """Observation -> a number for each action."""
    inputs, actions = envs.single_observation_space.shape[0], envs.single_action_space.n
    return nn.Sequential(nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, actions))


def logits(net: nn.Module, seen: np.ndarray, mask: np.ndarray) -> torch.Tensor:
    """What the network says of each action; minus infinity where it is invalid."""
    return net(torch.as_tensor(seen)).masked_fill(torch.as_tensor(mask == 0), -torch.inf)


def play(envs: SenderVectorEnv, act, seed: int, judge: expert.Clairvoyant | None = None):
    """One episode in each row: (observations, masks, regrets of all actions) of all states, and H at the ends."""
    envs.reset(seed=seed)
    states = []
    while not envs.rows.output.terminated.all():
        output = envs.rows.output
        seen, mask = output.flat.copy(), output.action_mask.copy()
        if judge is not None:
            regrets = judge.regrets()
            due = ~np.isnan(regrets).all(axis=1)
            states.append((seen[due], mask[due], np.nan_to_num(regrets[due]).astype(np.float32)))
        envs.rows.step(act(seen, mask))
    return [np.concatenate(part) for part in zip(*states, strict=True)], envs.rows.output.qoi.copy()


def learn(net: nn.Module, states: list[np.ndarray], epochs: int, optimizer: torch.optim.Optimizer) -> None:
    """Make the expected regret of the network's actions small."""
    seen, mask, regrets = states
    for _ in range(epochs):
        for batch in np.array_split(np.random.permutation(len(seen)), max(1, len(seen) // 1024)):
            chances = logits(net, seen[batch], mask[batch]).softmax(1)
            loss = (chances * torch.as_tensor(regrets[batch])).sum(1).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()


def scores(qoi: np.ndarray, envs: SenderVectorEnv, names: tuple[str, ...]) -> dict[str, float]:
    """Scores (0: Drop Oldest, 1: the clairvoyant) on the episodes that ``envs`` holds: ours, and fixed policies'."""
    v, L = envs.rows.scenario.value, envs.rows.capacity
    episodes = [episode for episode in envs.rows.senders.episodes if isinstance(episode, Episode)]
    best = sum(clairvoyant(episode, L, v).qoi for episode in episodes)

    def total(name: str) -> float:
        senders = run(policies.get(name), episodes, L, v)
        return sum(outcome(senders, i).qoi for i in range(len(episodes)))

    base = total("drop-oldest")
    reached = {"this network": qoi.sum(), **{name: total(name) for name in names}}
    return {name: float(normalised_score(h, base, best)) for name, h in reached.items()}


def main() -> dict[str, float]:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=6)
    parser.add_argument("--episodes", type=int, default=32, help="in each round")
    parser.add_argument("--epochs", type=int, default=3, help="through all states so far, each round")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    np.random.seed(options.seed)
    torch.set_num_threads(1)
    envs = SenderVectorEnv(options.episodes, "lte", autoreset_mode="Disabled", **TASK)
    judge, net, rng = expert.clairvoyant(envs), network(envs), np.random.default_rng(options.seed)
    optimizer = torch.optim.Adam(net.parameters(), 1e-3)

    def act(seen: np.ndarray, mask: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return logits(net, seen, mask).argmax(1).numpy()

    def first(seen: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """In the first round half of the rows follow the clairvoyant, the others chance."""
        chance = np.argmax(rng.random(mask.shape) * mask, axis=1)
        return np.where(np.arange(len(mask)) % 2, judge.actions(), chance)

    memory: list[np.ndarray] = []
    for k in range(options.rounds):
        states, qoi = play(envs, act if k else first, 1_000 * (k + 1) + options.seed, judge)
        memory = states if not memory else [np.concatenate(pair) for pair in zip(memory, states, strict=True)]
        learn(net, memory, options.epochs, optimizer)
        print(f"round {k + 1}: {len(memory[0]):,} states, mean H of what was played {qoi.mean():.3f}")
    test = SenderVectorEnv(200, "lte", autoreset_mode="Disabled", **TASK)
    _, qoi = play(test, act, 10**6)
    reached = scores(qoi, test, ("afr", "min-motion-gap"))
    for name, score in reached.items():
        print(f"score of {name}: {score:.3f}")
    return reached


if __name__ == "__main__":
    main()
