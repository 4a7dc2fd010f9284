"""Families of runs, on which agents are compared by the share of AFR's regret that they leave.

A *family* is a list of runs: an episode at one L and B, with the clairvoyant's H and AFR's. An agent's figure on a
family is the share of AFR's regret, as a ratio of sums; ``random``, whose runs differ in everything, has the mean of
ratios.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.evaluation import Numbers, qoi_of
from bufgym import policies
from bufgym.benchmark.bootstrap import RESAMPLES, SEED, Interval, interval, times_drawn
from bufgym.oracle import clairvoyant
from bufgym.policies import Policy
from bufgym.scenario.numbered import draw
from bufgym.sim import Senders

LEAST, MOST = 0.01, 4.0
"""Added to both regrets in a ratio of single runs, and the largest ratio."""
Run = dict[str, Any]
"""``link``, ``scenario``, ``episode``, ``capacity``, ``max_bytes``, ``value``, and ``best``, the clairvoyant's H."""


def drawn_run(link: str, scenario: Any, seed: int, capacity: int, max_bytes: int | None = None) -> Run:
    """One run without its bound, which takes longer than the run itself."""
    known = {"link": link, "scenario": scenario, "capacity": capacity, "max_bytes": max_bytes}
    return {**known, "episode": draw(scenario, seed), "value": scenario.value, "best": math.nan}


def bound_of(run: Run) -> float:
    """The clairvoyant's H, or with unequal sizes a bound above it."""
    return clairvoyant(run["episode"], run["capacity"], run["value"], max_bytes=run["max_bytes"]).qoi


def run_of(link: str, scenario: Any, seed: int, capacity: int, max_bytes: int | None = None) -> Run:
    """One run, with its bound."""
    run = drawn_run(link, scenario, seed, capacity, max_bytes)
    return {**run, "best": bound_of(run)}


class Family:
    """Some runs of one family, loaded for policies to play."""

    def __init__(self, name: str, runs: Sequence[Run]) -> None:
        self.name, self.best = name, np.array([run["best"] for run in runs])
        self.decisions = sum(len(run["episode"].arrivals) for run in runs)
        self.capacity = np.array([run["capacity"] for run in runs])
        self._link = np.unique([run["link"] for run in runs], return_inverse=True)[1]
        self.links = int(self._link.max()) + 1
        groups: dict[Any, list[int]] = {}
        for i, run in enumerate(runs):
            groups.setdefault((run["capacity"], run["max_bytes"], run["value"].name), []).append(i)
        self._groups: list[tuple[list[int], list[Any], Senders]] = []
        for (capacity, max_bytes, _), own in groups.items():
            episodes = [runs[i]["episode"] for i in own]
            longest = max(len(episode.arrivals) for episode in episodes)
            value = runs[own[0]]["value"]
            senders = Senders(len(own), capacity, value, max_messages=longest, max_bytes=max_bytes)
            self._groups.append((own, episodes, senders))
        self.afr = self.play(policies.get("afr"))

    def play(self, policy: Policy) -> Numbers:
        """H of each run, float64[runs]."""
        h = np.empty(len(self.best))
        for own, episodes, senders in self._groups:
            h[own] = qoi_of(policy, senders, episodes)
        return h

    def shares(
        self, h: Numbers, weights: NDArray[np.float64] | None = None, part: NDArray[np.bool_] | None = None
    ) -> Numbers:
        """The share of AFR's regret, float64[1 + resamples].

        ``weights`` count the draws of each link, and ``part``, bool[runs], says which runs count; by default all do.
        """
        counts = np.ones((1, len(self.best))) if weights is None else weights[:, self._link]
        counts = counts if part is None else counts * part
        if self.name.startswith("random"):
            ratios = np.clip((1 - h / self.best + LEAST) / (1 - self.afr / self.best + LEAST), 0, MOST)
            return np.asarray(counts @ ratios / counts.sum(axis=1))
        return np.asarray(counts @ (self.best - h) / (counts @ (self.best - self.afr)))

    def share(self, policy: Policy) -> float:
        """The share of AFR's regret."""
        return float(self.shares(self.play(policy))[0])

    def against(self, several: Sequence[Policy]) -> list[tuple[float, list[Interval]]]:
        """Each policy's share, and how far it lies above each other's, with an interval over links."""
        weights = times_drawn(self.links, RESAMPLES, np.random.default_rng(SEED))
        shares = [self.shares(self.play(policy), weights) for policy in several]
        return [(float(own[0]), [interval(own - other, self.links) for other in shares]) for own in shares]
