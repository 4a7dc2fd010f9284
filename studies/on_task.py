"""Does an agent do a robot's own task better if that task is its reward? An experiment on `bufgym/Mapping-v0`.

    python -m studies.on_task

Evolution finds the numbers of a rule under each of three rewards. The first is the information that arrives, by the
motion of the camera, which is every environment's default. The others are `covered` and `followed`, which stands in for
`tracked` as that takes seconds an episode. All begin as the plain rule `gap-price`. Tests use links that none has seen,
and measure real tracking and coverage.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.cma_es import Search, evaluation_here
from agents.objectives.objective import Evolved
from bufgym import policies
from bufgym.benchmark.bootstrap import interval, stream, times_drawn
from bufgym.policies import Policy
from bufgym.scenario.numbered import by_trace, draw
from bufgym.sim import Senders
from bufgym_papers.perception import worth
from studies.page import command, publish, table

TEST_LINKS = 2
"""Number of shipped links for tests alone, the last ones."""
PARTS, PART_EPISODES = 8, 24
"""Parts of the training episodes, one a generation in turn, and episodes in each."""
RIVALS = ("afr", "drop-oldest", "min-motion-gap", "gap-price", "learned")
RESAMPLES = 2000

Frames = NDArray[np.int64]


def information(frames: Frames) -> float:
    """H of these frames by motion."""
    scenario = worth.mapping()
    x = scenario.workload.x if scenario.workload is not None else None
    assert x is not None
    return scenario.value.information(x[frames])


REWARDS: Mapping[str, Callable[[Frames], float]] = {
    "information": information,
    "covered": worth.coverage_of,
    "followed": worth.least_followed,
}
"""Rewards for evolution."""
TESTED: Mapping[str, Callable[[Frames], float]] = {**REWARDS, "tracked": worth.tracked_part}
"""Measures for tests."""


class Episodes:
    """Episodes of `bufgym/Mapping-v0` side by side, with a queue of L messages."""

    def __init__(self, pairs: Sequence[tuple[int, int]], L: int) -> None:
        """``pairs`` has the (link, seed) of each episode."""
        scenario = worth.mapping()
        links = by_trace(scenario)
        self.episodes = [draw(links[link][1], seed) for link, seed in pairs]
        self._senders = Senders(len(pairs), L, scenario.value, max_messages=scenario.max_messages)
        self.decisions = len(pairs) * worth.FRAMES

    def arrived(self, policy: Policy) -> list[Frames]:
        """The frames that arrive in each episode."""
        for i, episode in enumerate(self.episodes):
            self._senders.load(i, episode)
        self._senders.run(policy)
        transmitted = np.asarray(self._senders.batch.log["transmitted_us"])[:, : worth.FRAMES]
        return [np.flatnonzero(row >= 0) for row in transmitted]


class Task(Evolved):
    """The mean of a reward over episodes of the training links."""

    name = "on-task"
    best = max

    def __init__(self, reward: str, L: int, seed: int) -> None:
        self.reward = REWARDS[reward]
        rng, links = np.random.default_rng(seed), len(worth.mapping().traces) - TEST_LINKS
        self.training = [
            [Episodes([(k % links, int(rng.integers(10**6))) for k in range(PART_EPISODES)], L)] for _ in range(PARTS)
        ]

    def measure(self, policy: Policy, episodes: Any, part: int | None = None) -> float:
        return float(np.mean([self.reward(frames) for each in episodes for frames in each.arrived(policy)]))


def evolved(reward: str, L: int, seed: int, generations: int) -> Policy:
    """The agent after so many generations."""
    task = Task(reward, L, seed)
    state = Search.around(task.start(), task.sigma, seed)
    for _ in range(generations):
        state.generation(evaluation_here(task))
    return state.agent.policy(task.name)


def tested(policy: Policy, episodes: Episodes) -> dict[str, NDArray[np.float64]]:
    """Measure -> its value in each episode."""
    arrived = episodes.arrived(policy)
    return {name: np.array([measure(frames) for frames in arrived]) for name, measure in TESTED.items()}


def main(
    generations: int = 120, seeds: int = 2, capacity: int = 8, episodes: int = 40, out: Path | None = None
) -> None:
    """A table of agents evolved by each reward, beside fixed policies.

    Args:
        generations: of 16 candidates each.
        seeds: training seeds of each reward.
        capacity: L, messages.
        episodes: number of test episodes, on the test links.
        out: the Markdown file; printed in any case.
    """
    links = len(worth.mapping().traces)
    test = Episodes([(links - 1 - k % TEST_LINKS, k) for k in range(episodes)], capacity)
    found = {name: [tested(policies.get(name), test)] for name in RIVALS}
    for reward in REWARDS:
        found[f"agent by {reward}"] = runs = []
        for seed in range(seeds):
            runs.append(tested(evolved(reward, capacity, seed, generations), test))
            print(f"agent by {reward}, seed {seed}: tracked {runs[-1]['tracked'].mean():.3f}", file=sys.stderr)
    tracked = {name: np.mean([run["tracked"] for run in runs], axis=0) for name, runs in found.items()}
    weights = times_drawn(episodes, RESAMPLES, stream(0, "on task")) / episodes

    def ahead(name: str, base: str) -> str:
        """Gain in tracking over the other policy, paired over episodes."""
        if name == base:
            return ""
        more = interval(weights @ (tracked[name] - tracked[base]), episodes)
        return f"{more.value:+.3f} [{more.low:+.3f}, {more.high:+.3f}]"

    bases = {"AFR's": RIVALS[0], "the agent's by information": f"agent by {next(iter(REWARDS))}"}
    rows = []
    for name, runs in found.items():
        means = [f"{np.mean([run[measure] for run in runs]):.3f}" for measure in TESTED]
        rows.append([name, *means, *(ahead(name, base) for base in bases.values())])
    heads = ["", *TESTED, *(f"tracked, less {whose} [95 %]" for whose in bases)]
    publish("\n".join(table(heads, rows)), out)


if __name__ == "__main__":
    command(main)
