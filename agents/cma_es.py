"""Evolution: an agent's weights by CMA-ES over whole episodes, rolled out in compiled code.

PPO learns from single decisions by costly updates. Here a candidate is a vector of weights, and its fitness comes from
whole episodes (``objectives``). A rollout decides two million times a second, so a few minutes suffice. All candidates
of a generation meet the same episodes (common random numbers), so only their decisions tell them apart. The next
generation meets others, and validation episodes say which mean to keep. The optimiser is pycma (Hansen, The CMA
Evolution Strategy: A Tutorial, arXiv 1604.00772).
"""

from __future__ import annotations

import functools
import pickle
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cma
import numpy as np

from agents.cluster import connected, running
from agents.learner import Learner
from agents.objectives import OBJECTIVES
from agents.objectives.objective import Evolved, Vector
from agents.runs import MODEL, Record, Run, Validations, seed_bar
from agents.settings import Evolve
from bufgym.policies import weights
from bufgym.policies.guided import GuidedWeights
from bufgym.utils.files import replaced

POPULATION = 16
"""Candidates per generation."""
MEMORY = 10
"""Generations over which the strategy's mean is averaged, exponentially."""


Evaluate = Callable[[Sequence[GuidedWeights], int], list[tuple[float, int]]]
"""(candidates, part of the training episodes) -> (fitness, decisions) of each, in their order."""


def evaluation_here(objective: Evolved) -> Evaluate:
    """Evaluate candidates in this process, one after the other."""

    def evaluate(candidates: Sequence[GuidedWeights], part: int) -> list[tuple[float, int]]:
        return [_evaluated(objective, candidate, part) for candidate in candidates]

    return evaluate


@contextmanager
def evaluation(settings: Evolve, folder: Path, seed: int, objective: Evolved) -> Iterator[Evaluate]:
    """Evaluate as the settings say: here, or on their cluster, with that seed's ``objective``."""
    if settings.cluster is None:
        yield evaluation_here(objective)
        return
    with connected(settings.cluster) as call_each:

        def evaluate(candidates: Sequence[GuidedWeights], part: int) -> list[tuple[float, int]]:
            calls = [(settings, folder, seed, candidate, part) for candidate in candidates]
            return call_each(evaluated_on_a_worker, calls)

        yield evaluate


_ONE_AT_A_TIME = threading.Lock()
"""Rollouts write to their objective's buffers, and a Dask worker may have several threads."""


def evaluated_on_a_worker(
    settings: Evolve, folder: Path, seed: int, candidate: GuidedWeights, part: int
) -> tuple[float, int]:
    """The fitness and the decisions of one candidate. Each process draws and bounds the episodes once."""
    with _ONE_AT_A_TIME:
        return _evaluated(_objective(settings, folder, seed), candidate, part)


def objective_of(settings: Evolve, folder: Path, seed: int) -> Evolved:
    """The task of a run for one seed."""
    found = OBJECTIVES[settings.kind](settings, folder, seed)
    assert isinstance(found, Evolved)
    return found


_objective = functools.lru_cache(maxsize=32)(objective_of)  # several seeds and runs meet on one worker


def _evaluated(objective: Evolved, candidate: GuidedWeights, part: int) -> tuple[float, int]:
    fitness = objective.fitness(candidate.policy(objective.name), part)
    return fitness, objective.decisions(part)


@dataclass
class Search:
    """The state of one seed's evolution, as in a checkpoint."""

    like: GuidedWeights
    """Weights with the numbers that are not searched."""
    strategy: Any
    """pycma's strategy."""
    average: Vector
    """The agent: an average of the strategy's latest means (``MEMORY``), in which the noise of single parts cancels."""
    steps: int = 0
    """Decisions rolled out so far."""
    generations: int = 0
    """Generations of this search."""
    seconds: float = 0.0
    """Time spent training, s."""

    @staticmethod
    def around(like: GuidedWeights, sigma: float, seed: int) -> Search:
        """A new search around these weights."""
        begin = like.weight.reshape(-1).astype(np.float64)
        options = {"seed": seed + 1, "popsize": POPULATION, "verbose": -9}
        return Search(like, cma.CMAEvolutionStrategy(begin, sigma, options), begin)

    def weights(self, vector: Vector) -> GuidedWeights:
        """The agent with these numbers."""
        return replace(self.like, weight=vector.reshape(self.like.weight.shape).astype(np.float32))

    @property
    def agent(self) -> GuidedWeights:
        """The agent so far."""
        return self.weights(self.average)

    def generation(self, evaluate: Evaluate) -> float:
        """Ask for candidates, evaluate them and report their fitness, once; return the best fitness."""
        vectors = self.strategy.ask()
        results = evaluate([self.weights(vector) for vector in vectors], self.generations)
        fitness = [each for each, _ in results]
        self.strategy.tell(vectors, fitness)
        self.average = self.average + (self.strategy.mean - self.average) / MEMORY
        self.steps += sum(decisions for _, decisions in results)
        self.generations += 1
        return float(np.min(fitness))


class Evolution(Learner[Evolve]):
    """CMA-ES on the numbers of a rule."""

    def train(self, folder: Path) -> list[Run]:
        """Train every seed; with a cluster all seeds share it."""
        if self.settings.cluster is None:
            return super().train(folder)
        with running(self.settings.cluster) as cluster:
            return super(Evolution, Evolution(replace(self.settings, cluster=cluster), self.seconds)).train(folder)

    def train_seed(self, folder: Path, seed: int, line: int = 0) -> Run:
        """Evolve one seed until ``settings.steps`` decisions were rolled out, from its last checkpoint if any.

        The agent with the best validation, the same measure on other episodes, is kept as ``model.safetensors``.
        """
        settings, home = self.settings, folder / f"seed-{seed}"
        home.mkdir(exist_ok=True)
        objective = objective_of(settings, folder, seed)
        checkpoint = home / "evolution.pkl"  # only from your own run: pickles run code when they are read
        if checkpoint.exists():
            state: Search = pickle.loads(checkpoint.read_bytes())
        else:
            state = Search.around(objective.start(), objective.sigma, seed)
        curve = Record(home / "curve.csv", ("steps", "seconds", "fitness"), state.steps)
        validations = Validations(home, objective.columns, objective.best, settings, state.steps)
        began = time.perf_counter() - state.seconds
        bar = seed_bar(settings.steps, state.steps, seed, line)
        with evaluation(settings, folder, seed, objective) as evaluate:
            while True:
                ended = state.steps >= settings.steps or state.seconds >= self.seconds
                if validations.due(state.steps, last=ended):
                    measures = objective.validate(state.agent.policy(objective.name))
                    if validations.add(state.steps, state.seconds, measures):
                        weights.save(home / MODEL, state.agent, self.notes(seed, objective.name))
                    report = objective.message.format(*measures)
                    bar.set_postfix_str(report, refresh=False)
                    if not sys.stderr.isatty():
                        print(f"seed {seed}: {state.steps:,} of {settings.steps:,} steps, {report}", flush=True)
                if ended:
                    break
                fitness = state.generation(evaluate)
                state.seconds = round(time.perf_counter() - began, 3)
                curve.append(state.steps, state.seconds, fitness)
                with replaced(checkpoint) as unfinished:
                    unfinished.write_bytes(pickle.dumps(state))
                bar.update(state.steps - bar.n)
        bar.close()
        return Run(seed, home, state.seconds, curve.rows, validations.rows, MODEL, objective.best)
