"""PPO in one file: a camera's send buffer on the native batch, with ordered candidates as actions.

    pip install ".[train]"
    python examples/ppo.py

It trains on six of the eight shipped links and tests on the other two, where ``bufgym bench`` has the same episodes:

    bufgym bench --trace lte-synthetic-6 lte-synthetic-7 --seeds 40 --policies afr,min-motion-gap,drop-oldest

Proximal policy optimisation (Schulman et al. 2017) with generalised advantage estimation (2016), as in CleanRL's
``ppo.py``. Nothing in it is special to a buffer: the environment's three actions are all valid, so there are no masks,
and its 27 numbers are scaled already. The reward ``regret`` compares each decision with the best that was still
possible. It knows the link's future; the observation and the test do not.
"""

import argparse
import time
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Categorical

import bufgym
from bufgym import BufgymError, policies, scenario

TRAIN = [f"lte-synthetic-{k}" for k in range(6)]
TEST = ["lte-synthetic-6", "lte-synthetic-7"]


@dataclass
class Settings:
    """Arguments of ``main`` and options of the command line."""

    seed: int = 0
    capacity: int = 8
    """L, messages."""
    duration_s: float = 30.0
    """Length of an episode."""
    steps: int = 600_000
    """Decisions to learn from."""
    num_envs: int = 64
    """Environments side by side, stepped by one compiled call."""
    num_steps: int = 32
    """Decisions of each environment between updates."""
    minibatch: int = 256
    """Decisions of one gradient step."""
    epochs: int = 3
    """Passes over the decisions of an update."""
    learning_rate: float = 1e-3
    """Learning rate at the start; it falls linearly to 0."""
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    """Largest relative change of an action's probability in an update."""
    reward: str = "regret"
    """Term of the reward in training; "retained" knows no future."""
    width: int = 64
    """Hidden units a layer."""
    test_seeds: int = 40
    """Test episodes on each held-out link."""


class Network(nn.Module):
    """Observations [n, inputs] -> logits [n, actions] and values [n]."""

    def __init__(self, inputs: int, actions: int, width: int) -> None:
        super().__init__()
        self.actor, self.critic = (
            nn.Sequential(
                *(nn.Linear(inputs, width), nn.Tanh(), nn.Linear(width, width), nn.Tanh(), nn.Linear(width, outputs))
            )
            for outputs in (actions, 1)
        )

    def forward(self, observation: Tensor) -> tuple[Tensor, Tensor]:
        return self.actor(observation), self.critic(observation)[:, 0]


def advantages_of(rewards: Tensor, values: Tensor, ended: Tensor, gamma: float, gae_lambda: float) -> Tensor:
    """Generalised advantage estimation, [steps, n], from ``values`` [steps + 1, n] and episode ends ``ended``."""
    advantages, after = torch.zeros_like(rewards), torch.zeros(rewards.shape[1])
    for t in reversed(range(len(rewards))):
        goes_on = 1 - ended[t]
        surprise = rewards[t] + gamma * goes_on * values[t + 1] - values[t]
        after = surprise + gamma * gae_lambda * goes_on * after
        advantages[t] = after
    return advantages


def make(
    traces: list[str], num_envs: int, settings: Settings, reward: str, mode: gym.vector.AutoresetMode
) -> gym.vector.VectorEnv:
    """The native batch; the agent is asked where the buffer is full."""
    return gym.make_vec(
        "bufgym/Uplink-v1",
        num_envs,
        capacity=settings.capacity,
        traces=traces,
        duration_s=settings.duration_s,
        reward=reward,
        info="mask",
        autoreset_mode=mode,
    )


class Test:
    """The agent on the benchmark's episodes over the held-out links, against AFR, Drop Oldest and the clairvoyant."""

    __test__ = False  # no class of pytest's

    def __init__(self, settings: Settings) -> None:
        uplink = scenario.get("lte", traces=TEST, duration_s=settings.duration_s)
        fixed = [policies.get(name) for name in ("drop-oldest", "afr")]
        rows = bufgym.compare(fixed, uplink, capacity=settings.capacity, seeds=settings.test_seeds).rows
        self.h = {p.name: sum(row["qoi"] for row in rows if row["policy"] == p.name) for p in fixed}
        self.best = sum(row["clairvoyant"] for row in rows if row["policy"] == "afr")
        self.episodes = [{"trace": trace, "seed": seed} for trace in TEST for seed in range(settings.test_seeds)]
        self.envs = make(TEST, len(self.episodes), settings, "retained", gym.vector.AutoresetMode.NEXT_STEP)

    def play(self, network: Network) -> float:
        """Sum of H if the network always takes its best action."""
        observation, _ = self.envs.reset(options={"episodes": self.episodes})
        h, live = 0.0, np.ones(len(self.episodes), np.bool_)
        while live.any():
            with torch.no_grad():
                actions = network.actor(torch.from_numpy(observation)).argmax(dim=1)
            observation, _, ended, _, info = self.envs.step(actions.numpy())
            if ended.any():
                h += info["qoi"][ended & live].sum()
            live &= ~ended
        return float(h)

    def regret(self, h: float) -> float:
        """The share of the clairvoyant's H that was lost."""
        return 1 - h / self.best

    def score(self, h: float) -> float:
        """Score of the agent, where Drop Oldest has 0 and the clairvoyant 1."""
        return (h - self.h["drop-oldest"]) / (self.best - self.h["drop-oldest"])


def main(settings: Settings) -> dict[str, float]:
    """Train and test; return regret and score of the agent and of AFR, and the CPU seconds of training."""
    torch.manual_seed(settings.seed)
    torch.set_num_threads(1)  # more only wait for one another on batches this small
    envs = make(TRAIN, settings.num_envs, settings, settings.reward, gym.vector.AutoresetMode.SAME_STEP)
    test = Test(settings)
    inputs, actions = envs.single_observation_space.shape[0], int(envs.single_action_space.n)
    network = Network(inputs, actions, settings.width)
    optimizer = torch.optim.Adam(network.parameters(), settings.learning_rate, eps=1e-5)
    steps, n = settings.num_steps, settings.num_envs
    updates = max(1, settings.steps // (steps * n))
    observation = torch.from_numpy(envs.reset(seed=settings.seed)[0])
    print(f"afr: score {test.score(test.h['afr']):.3f}, regret {test.regret(test.h['afr']):.2%}")
    spent_s = 0.0
    for update in range(updates + 1):
        if update % max(1, updates // 10) == 0 or update == updates:
            h = test.play(network)
            report = f"score {test.score(h):.3f}, regret {test.regret(h):.2%}, {spent_s:.0f} CPU seconds of training"
            print(f"{update * steps * n:,} decisions: {report}", flush=True)
        if update == updates:
            break
        began = time.process_time()
        optimizer.param_groups[0]["lr"] = settings.learning_rate * (1 - update / updates)
        # Play.
        played: dict[str, list[Tensor]] = {}
        for _ in range(steps):
            with torch.no_grad():
                logits, value = network(observation)
                choice = Categorical(logits=logits, validate_args=False)
                action = choice.sample()
            decision = {"observation": observation, "action": action, "value": value, "log_p": choice.log_prob(action)}
            seen, reward, ended, _, _ = envs.step(action.numpy())
            observation = torch.from_numpy(seen)  # no copy: the next step writes another array
            decision |= {"reward": torch.from_numpy(reward).float(), "ended": torch.from_numpy(ended).float()}
            for name, column in decision.items():
                played.setdefault(name, []).append(column)
        with torch.no_grad():
            played["value"].append(network(observation)[1])
        batch = {name: torch.stack(column) for name, column in played.items()}
        advantages = advantages_of(batch["reward"], batch["value"], batch["ended"], settings.gamma, settings.gae_lambda)
        batch["target"] = advantages + batch["value"][:-1]
        batch["advantage"] = advantages
        # Learn.
        flat = {name: batch[name].flatten(0, 1) for name in batch if name not in ("value", "reward", "ended")}
        for _ in range(settings.epochs):
            for chosen in torch.randperm(steps * n).split(settings.minibatch):
                part = {name: column[chosen] for name, column in flat.items()}
                logits, value = network(part["observation"])
                log_p = torch.log_softmax(logits, dim=1)
                ratio = (log_p.gather(1, part["action"][:, None])[:, 0] - part["log_p"]).exp()
                gain = (part["advantage"] - part["advantage"].mean()) / (part["advantage"].std() + 1e-8)
                clipped = ratio.clamp(1 - settings.clip, 1 + settings.clip)
                loss = -torch.min(ratio * gain, clipped * gain).mean()
                loss = loss + 0.5 * (value - part["target"]).square().mean()
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(network.parameters(), 0.5)
                optimizer.step()
        spent_s += time.process_time() - began
    return {
        "regret": test.regret(h),
        "score": test.score(h),
        "afr_regret": test.regret(test.h["afr"]),
        "afr_score": test.score(test.h["afr"]),
        "cpu_s": spent_s,
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name, default in vars(Settings()).items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(default), default=default, help="(%(default)s)")
    try:
        main(Settings(**vars(parser.parse_args())))
    except BufgymError as error:
        raise SystemExit(f"error: {error}") from None
