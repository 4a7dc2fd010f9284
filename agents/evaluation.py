"""A suite's episodes to validate and test agents on, with the results of the fixed policies and the clairvoyant.

Episodes and rows of fixed policies equal ``bufgym bench`` on the same split.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
from filelock import FileLock
from numpy.typing import NDArray

from agents.mixed_env import Cell, cells
from agents.settings import Settings
from bufgym.benchmark.rows import Row
from bufgym.benchmark.run import run as run_policies
from bufgym.benchmark.score import DISCRIMINATIVE, regret
from bufgym.benchmark.sweep import Sweep, run_sweep
from bufgym.oracle import measure, normalised_score
from bufgym.oracle.measure import BASELINE
from bufgym.policies import Policy
from bufgym.scenario import Episode
from bufgym.scenario.numbered import by_trace, draw
from bufgym.sim import Senders, run
from bufgym.sim.metrics import Outcome, outcome
from bufgym.utils.errors import BufgymError

Numbers = NDArray[np.float64]


def qoi_of(policy: Policy, senders: Senders, episodes: Sequence[Episode]) -> Numbers:
    """H of each episode under a policy; ``senders`` has a row for each, and is loaded anew."""
    senders.load_all([(i, episode, None) for i, episode in enumerate(episodes)])
    senders.run(policy)
    sender = senders.batch.senders
    return np.asarray(sender["delivered_gain"] + (sender["transmitted"] > 0), np.float64)


def play(agent: Policy, cells: Sequence[Cell], sizes: Sequence[int], episodes: Sequence[Episode]) -> list[Outcome]:
    """The outcome of each episode, ``sizes[c]`` of them in cell c, one cell after the other."""
    ends = np.cumsum(sizes).tolist()
    outcomes = []
    for cell, size, end in zip(cells, sizes, ends, strict=True):
        senders = run(agent, episodes[end - size : end], cell.capacity, cell.scenario.value, max_bytes=cell.max_bytes)
        outcomes += [outcome(senders, i) for i in range(size)]
    return outcomes


class Verdict(NamedTuple):
    """An agent's validation: means over the discriminative cells (see ``benchmark.score``).

    ``score`` is 0 for Drop Oldest and 1 for the clairvoyant. ``regret`` is 1 - H / the clairvoyant's. ``over_afr`` is
    regret over AFR's regret.
    """

    score: float
    regret: float
    over_afr: float


class EvaluationSet:
    """Every episode of the sweep's split at every capacity; the rows of its fixed policies are kept in ``folder``."""

    def __init__(self, sweep: Sweep, folder: Path, *, progress: bool = False) -> None:
        self.sweep = sweep = sweep.checked()
        jobs = -1 if importlib.util.find_spec("joblib") else 1
        self.rows = run_sweep(sweep, folder, jobs=jobs, progress=progress)
        drawn: dict[str, list[tuple[Row, Episode]]] = {label: [] for label in sweep.settings()}
        for shard in sweep.shards():
            trace, scenario = by_trace(sweep.setting(shard.label, shard.trace).scenario)[0]
            for seed in shard.seeds:
                key = {"scenario": shard.label, "trace": trace, "seed": seed}
                drawn[shard.label].append((key, draw(scenario, seed)))
        self.cells = cells(sweep.suite, sweep.split, sweep.capacities, sweep.data)
        self._sizes = [len(drawn[c.label]) for c in self.cells]
        self._keys = [key | {"capacity": c.capacity} for c in self.cells for key, _ in drawn[c.label]]
        self._episodes = [episode for c in self.cells for _, episode in drawn[c.label]]
        self._fixed = {(*_name(row), row["policy"]): row for row in self.rows}

    def fixed(self, policy: str, column: str = "qoi") -> Numbers:
        """[rows]: this column of a fixed policy's rows."""
        return np.array([self._fixed[*_name(key), policy][column] for key in self._keys], np.float64)

    def play(self, agent: Policy) -> list[Outcome]:
        """Outcomes of an agent in every row."""
        return play(agent, self.cells, self._sizes, self._episodes)

    def verdict(self, outcomes: Sequence[Outcome]) -> Verdict:
        """An agent's outcomes against Drop Oldest, AFR and the clairvoyant; the sweep must have both policies."""
        qoi = np.array([result.qoi for result in outcomes])
        first = np.cumsum([0, *self._sizes[:-1]])
        agent, base, afr, best = (
            np.add.reduceat(column, first)
            for column in (qoi, self.fixed(BASELINE), self.fixed("afr"), self.fixed("afr", "clairvoyant"))
        )
        counted = regret(base, best) >= DISCRIMINATIVE
        if not counted.any():
            raise BufgymError(
                f"suite {self.sweep.suite}, L = {list(self.sweep.capacities)}: Drop Oldest cannot be bettered"
            )
        agent, base, afr, best = agent[counted], base[counted], afr[counted], best[counted]
        regrets, afr_regrets = float(regret(agent, best).mean()), float(regret(afr, best).mean())
        score = float(normalised_score(agent, base, best).mean())
        return Verdict(score, regrets, regrets / afr_regrets if afr_regrets else np.inf)

    def benchmark_rows(self, outcomes: Sequence[Outcome], name: str, training_seed: int | None) -> list[Row]:
        """An agent's outcomes as rows of the benchmark, which name the training seed too, if there is one."""
        rows = []
        for key, result in zip(self._keys, outcomes, strict=True):
            fixed = self._fixed[*_name(key), BASELINE]
            known = {"clairvoyant": fixed["clairvoyant"], "certified": fixed["certified"]}
            known["regret"] = measure.regret(result.qoi, known["clairvoyant"])
            rows.append({**key, "policy": name, **asdict(result), **known, "training_seed": training_seed})
        return rows


def _name(row: Row) -> tuple[str, str, int, int]:
    return row["scenario"], row["trace"], row["seed"], row["capacity"]


def seeds_for(suite: str, split: str, capacities: Sequence[int], episodes: int, data: str | None) -> int:
    """Seeds a trace, so that all scenarios, traces and capacities together have about so many episodes."""
    one_seed = sum(len(shard.seeds) for shard in Sweep(suite, (), split, tuple(capacities), 1, data).checked().shards())
    return max(1, round(episodes / (one_seed * len(capacities))))


def sweep_for(
    settings: Settings, suite: str, split: str, specs: tuple[str, ...] = ("afr",), seeds: int | None = None
) -> Sweep:
    """The fixed policies, episodes and capacities of a split of one of the run's suites."""
    chosen = settings.suites
    capacities, data = chosen.capacities_of(suite), chosen.data
    if split == "validation":
        share = math.ceil(settings.validations() / len(chosen.suite))
        seeds = seeds_for(suite, split, capacities, share, data)
    return Sweep(suite, specs, split, capacities, seeds, data)


class ValidationSets:
    """The fixed validation episodes of all suites, made once and afterwards read from the run's folder."""

    def __init__(self, settings: Settings, folder: Path, progress: bool = False) -> None:
        home = folder / "validation"
        home.mkdir(parents=True, exist_ok=True)
        with FileLock(home / ".lock"):  # all seeds come here at once, and a sweep's folder refuses a second process
            self._sets = [
                EvaluationSet(sweep_for(settings, suite, "validation"), home / suite, progress=progress)
                for suite in settings.suites.names
            ]

    def play(self, agent: Policy) -> Verdict:
        """An agent's verdict, averaged over the suites."""
        verdicts = [evaluation.verdict(evaluation.play(agent)) for evaluation in self._sets]
        return Verdict(*np.mean(verdicts, axis=0).tolist())


def test_rows(settings: Settings, policies: Sequence[Policy]) -> list[Row]:
    """The rows of these policies on the test split of the run's one suite, of any kind."""
    chosen = settings.suites
    (suite,) = chosen.names
    sweep = Sweep(suite, (), "test", chosen.capacities_of(suite), chosen.test_seeds or None)
    rows = []
    for shard in sweep.checked().shards():
        scenario = sweep.setting(shard.label, shard.trace).scenario
        rows += run_policies(policies, scenario, sweep.capacities, shard.seeds, label=shard.label, progress=True)
    return rows
