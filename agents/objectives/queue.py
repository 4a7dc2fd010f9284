"""One queue: the regret over that of AFR or Drop Oldest, whichever is better, averaged over suites.

On interruptions the regret is *exact* over every length T (``oracle.EveryLength``). On other links it comes from
*sampled* episodes, the same for all candidates (common random numbers).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from agents.evaluation import ValidationSets, Verdict, qoi_of
from agents.mixed_env import Cell, cells
from agents.objectives.objective import Objective
from agents.settings import Settings
from bufgym import policies
from bufgym.benchmark.run import by_trace, draw
from bufgym.benchmark.tasks.queue import best
from bufgym.oracle import BASELINE, EveryLength, regret
from bufgym.policies import Policy, weights
from bufgym.policies.learned import Weights
from bufgym.policies.scoring import OF_INPUTS, Network
from bufgym.scenario import Interruption, Uplink
from bufgym.sim import Senders

SIGMA = 0.3
"""First step size; the start's weights are of the order of 10."""
SMALL = (1, 2, 3)
"""Further L to learn from, where the regret is exact and so costs next to nothing."""

PARTS, PART_EPISODES = 8, 12
"""Parts of a suite's training episodes, and episodes in each; interruptions are exact and have one part."""
EPISODES = 40
"""Sampled episodes of a suite by default, spread evenly over its cells; at least one per cell."""
VALIDATION_EPISODES, VALIDATION_SEED = 3 * EPISODES, 1

AT_LEAST = 0.003
"""Least regret of AFR that counts in a cell: below it there is next to nothing to gain."""
WORST = 3.0
"""Largest ratio that counts."""


def start(fields: tuple[str, ...], width: int, rng: np.random.Generator) -> Weights:
    """Drop by the smallest merged gap (of motion, if seen), older messages rather; accept with room."""
    drop, accept = (small_network(len(fields), (width,) if width else (), rng) for _ in range(2))
    weights = Weights(fields, drop, accept)
    merged = next(name for name in ("motion_merged", "index_merged", "time_merged") if name in fields)
    weights.drop.skip[fields.index(merged)] = -10.0
    weights.drop.skip[fields.index("rank")] = -0.4
    weights.accept.bias[0] = 5.0
    return replace(weights, mix=np.zeros((len(weights.context), len(weights.slot)), np.float32))


def small_network(inputs: int, widths: tuple[int, ...], rng: np.random.Generator) -> Network:
    """Small random weights in the hidden layers, zeros elsewhere."""
    layers = tuple(
        (rng.normal(0, 1 / np.sqrt(a), (a, b)).astype(np.float32), np.zeros(b, np.float32))
        for a, b in itertools.pairwise([inputs, *widths])
    )
    out = np.zeros(widths[-1] if widths else 0, np.float32)
    return Network(np.zeros(inputs, np.float32), np.zeros(1, np.float32), layers, out)


def reading(weights: Weights, fields: tuple[str, ...]) -> Weights:
    """Weights for more ``fields`` that give the same decisions; the new fields have weight 0."""
    new = tuple(name for name in fields if name not in weights.fields)

    def widened(network: Network) -> Network:
        tensors = network.tensors()
        for name in OF_INPUTS & tensors.keys():
            tensors[name] = np.pad(tensors[name], ((0, len(new)), (0, 0))[: tensors[name].ndim])
        return Network.of(tensors)

    more = replace(weights, fields=weights.fields + new, drop=widened(weights.drop), accept=widened(weights.accept))
    if weights.mix is None:
        return more
    rows, columns = len(more.context) - len(weights.context), len(more.slot) - len(weights.slot)
    return replace(more, mix=np.pad(weights.mix, ((0, rows), (0, columns))))


# --- the regret in a suite's cells -----------------------------------------------------------------------------------


class ExactRegrets:
    """Interruptions, exactly over every T."""

    def __init__(self, cells: Sequence[Cell]) -> None:
        self.cells = list(cells)
        indices: dict[Interruption, list[int]] = {}
        for i, cell in enumerate(self.cells):
            assert isinstance(cell.scenario, Interruption)
            indices.setdefault(cell.scenario, []).append(i)
        self._lengths = [
            (own, EveryLength(scenario, [self.cells[i].capacity for i in own])) for scenario, own in indices.items()
        ]
        self.decisions = sum(lengths.decisions for _, lengths in self._lengths)

    def regrets(self, policy: Policy) -> NDArray[np.float64]:
        """Regret of each cell."""
        by_cell = np.empty(len(self.cells))
        for indices, lengths in self._lengths:
            by_cell[indices] = lengths.regrets(policy)
        return by_cell


class SampledRegrets:
    """Episodes of cells with links; ``drawn`` has the (trace, seed) of each cell's episodes."""

    def __init__(self, cells: Sequence[Cell], drawn: Sequence[Sequence[tuple[int, int]]]) -> None:
        self.cells = list(cells)
        self.episodes, self._senders, self._best = [], [], []
        for (_, scenario, L), pairs in zip(cells, drawn, strict=True):
            episodes = [draw(by_trace(scenario)[trace][1], seed) for trace, seed in pairs]
            self.episodes.append(episodes)
            self._senders.append(Senders(len(pairs), L, scenario.value, max_messages=scenario.max_messages))
            self._best.append(sum(best(episode, L, scenario).qoi for episode in episodes))
        self.decisions = sum(len(episode.arrivals) for episodes in self.episodes for episode in episodes)

    def regrets(self, policy: Policy) -> NDArray[np.float64]:
        """Regret of each cell."""
        by_cell = []
        for episodes, senders, most in zip(self.episodes, self._senders, self._best, strict=True):
            by_cell.append(regret(float(qoi_of(policy, senders, episodes).sum()), most))
        return np.array(by_cell)


def sampled_regrets(cells: Sequence[Cell], seed: int, episodes: int = EPISODES) -> SampledRegrets:
    """Sample ``episodes`` episodes, traces in turn from cell to cell; fewer than cells cover only that many cells."""
    rng = np.random.default_rng(seed)
    chosen = list(cells)
    if episodes < len(chosen):
        chosen = [chosen[k] for k in sorted(rng.permutation(len(chosen))[:episodes])]
    per_cell = max(1, round(episodes / len(chosen)))
    drawn = []
    waiting: list[int] = []
    for cell in chosen:
        assert isinstance(cell.scenario, Uplink)
        while len(waiting) < per_cell:
            waiting += rng.permutation(len(cell.scenario.traces)).tolist()
        traces, waiting = waiting[:per_cell], waiting[per_cell:]
        drawn.append([(trace, int(rng.integers(10**6))) for trace in traces])
    return SampledRegrets(chosen, drawn)


CellRegrets = ExactRegrets | SampledRegrets


class SuiteObjective:
    """One suite: a policy's regrets over the rival's, the better of AFR and Drop Oldest in each cell.

    Args:
        parts: samples of the suite's cells, one a generation in turn.
    """

    def __init__(self, *parts: CellRegrets) -> None:
        self.parts = parts
        self.decisions = sum(part.decisions for part in parts)
        self.exact = all(isinstance(part, ExactRegrets) for part in parts)
        rivals = [policies.get(name) for name in ("afr", BASELINE)]
        regrets = [np.concatenate([part.regrets(rival) for part in parts]) for rival in rivals]
        self.rivals = np.maximum(AT_LEAST, np.minimum(*regrets))
        # Ratios of single sampled cells would be noise, so cells of one L and V are pooled. Exact ones each count.
        keys = [(cell.capacity, cell.scenario.value.name) for part in parts for cell in part.cells]
        kinds = list(dict.fromkeys(keys))
        pool = np.array([kinds.index(key) for key in keys])
        self._pools = np.split(pool, np.cumsum([len(part.cells) for part in parts])[:-1])
        self._pooled_rivals = np.array([self.rivals[pool == k].mean() for k in range(len(kinds))])

    def decisions_of(self, part: int | None = None) -> int:
        """Arrivals that one policy decides about, on all parts or on one."""
        return sum(self.parts[k].decisions for k in self._chosen(part))

    def over_rivals(self, policy: Policy, part: int | None = None) -> float:
        """Regret over the rival's: root mean square over the cells, so that the worst ones count most.

        ``part`` takes the policy's regret on that part alone, but over the rival's on all of them.
        """
        chosen = self._chosen(part)
        regrets = np.concatenate([self.parts[k].regrets(policy) for k in chosen])
        pool = np.concatenate([self._pools[k] for k in chosen])
        ratios = [min(WORST, regrets[pool == k].mean() / self._pooled_rivals[k]) for k in np.unique(pool)]
        return float(np.sqrt(np.mean(np.square(ratios))))

    def _chosen(self, part: int | None) -> Sequence[int]:
        return range(len(self.parts)) if part is None else [part % len(self.parts)]


def suite_objectives(
    settings: Settings, split: str, seed: int, episodes: int = EPISODES, parts: int = 1
) -> list[SuiteObjective]:
    """Objectives of every suite, drawn from ``seed``: ``parts`` times so many episodes, or the exact cells."""
    small = () if settings.capacities else SMALL
    rest = small, settings.data or None, split, seed, episodes, parts
    return [_suite_objective(suite, settings.capacities_of(suite), *rest) for suite in settings.suites]


@functools.lru_cache(maxsize=32)  # bounds take a minute
def _suite_objective(
    suite: str,
    capacities: tuple[int, ...],
    small: tuple[int, ...],
    data: str | None,
    split: str,
    seed: int,
    episodes: int,
    parts: int,
) -> SuiteObjective:
    suite_cells = cells(suite, split, capacities, data)
    if any(isinstance(cell.scenario, Uplink) for cell in suite_cells):
        return SuiteObjective(*(sampled_regrets(suite_cells, seed + 1000 * k, episodes) for k in range(parts)))
    suite_cells += cells(suite, split, [L for L in small if L not in capacities], data)
    return SuiteObjective(ExactRegrets(suite_cells))


class QueueObjective(Objective):
    """All suites of a run."""

    name = "evolved"
    columns = (*Verdict._fields, "over_rivals")
    best = min
    message = "regret {:.3f} x the rivals' on validation"
    sigma = SIGMA

    @functools.cached_property
    def _validation(self) -> ValidationSets:
        """Validation sets, made at first use: a worker that evaluates candidates needs none."""
        return ValidationSets(self.settings, self.folder)

    @functools.cached_property
    def training(self) -> list[list[SuiteObjective]]:
        """All suites, which have parts of their own."""
        return [suite_objectives(self.settings, "train", self.seed, PART_EPISODES, PARTS)]

    @functools.cached_property
    def judges(self) -> list[SuiteObjective]:
        """All suites."""
        return suite_objectives(self.settings, "validation", VALIDATION_SEED, VALIDATION_EPISODES)

    def start(self) -> Weights:
        """The rule "smallest merged gap", or an earlier agent."""
        settings, fields = self.settings, self.settings.observed
        if settings.start:
            return reading(weights.read(settings.start)[0], fields)
        return start(fields, settings.hidden, np.random.default_rng(self.seed))

    def measure(self, policy: Policy, episodes: Sequence[SuiteObjective], part: int | None = None) -> float:
        """Regret over the rivals', mean over the suites."""
        return float(np.mean([objective.over_rivals(policy, part) for objective in episodes]))

    def fitness(self, policy: Policy, part: int) -> float:
        """Regret over the rivals' on a part of the training episodes."""
        return self.measure(policy, self.training[0], part)

    def decisions(self, part: int) -> int:
        """Decisions over all suites."""
        return sum(objective.decisions_of(part) for objective in self.training[0])

    def validate(self, policy: Policy) -> tuple[float, ...]:
        """The verdict, and the fitness on other episodes."""
        return *self._validation.run(policy), *super().validate(policy)
