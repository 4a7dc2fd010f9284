"""Evolution: a slot scorer's weights by CMA-ES over whole episodes, rolled out in compiled code.

PPO learns from decisions one by one and pays for its updates; here a candidate is a vector of weights, its fitness the
regret over that of AFR or Drop Oldest, whichever is better (``grounds``), averaged over suites. A rollout decides two
million times a second, so a few minutes suffice. All candidates of a generation meet the same episodes, so that they
differ by what they decide alone (common random numbers); the next generation meets others of them (``PARTS``), and
validation episodes say which mean to keep. The optimiser is pycma (Hansen, The CMA Evolution Strategy: A Tutorial,
arXiv 1604.00772).

With a warm-up, two scorers are learned one after the other: first that for a link that stands still, from interruptions
alone (their mean over T is exact and cheap), then that for all other links, from the other suites.

The search begins at what is known to be good: drop what leaves the smallest merged gap, the newer of two rather than
the older, accept where there is room.
"""

from __future__ import annotations

import functools
import pickle
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cma
import numpy as np
from numpy.typing import NDArray

from agents.callbacks import Record, seed_bar
from agents.grounds import EPISODES, Yard, grounds
from agents.trials import ValidationSet, Verdict
from agents.worlds import capacities_of, cells
from bufgym.errors import BufgymError
from bufgym.files import replaced
from bufgym.policies import Policy, learned, weights
from bufgym.policies.learned import Network, Weights
from bufgym.scenario import Interruption, Uplink

if TYPE_CHECKING:
    from train import Arguments

TIME = ("rank", "time_before", "time_merged", "occupancy", "stalled", "service_ratio")
"""What a queue and a clock can tell, as AFR's."""

MOTION = (
    *("rank", "motion_before", "motion_merged", "loss", "relative_loss"),
    *("occupancy", "stalled", "service_ratio", "even_value", "bend"),
)
"""With odometry, and the V that is aimed at."""

SEES = {"time": TIME, "motion": MOTION}

POPULATION = 16
SIGMA = {True: 2.0, False: 0.3}
"""First step size, for the scorer of a still link or of a moving one; the start's weights are of the order of 10."""
DIAGONAL = 100
"""From so many weights on, a diagonal covariance (Ros and Hansen 2008) learns faster than a full one."""
SMALL = (1, 2, 3)
"""L to learn from besides the suite's own, where a ground is exact and so costs next to nothing."""

MEMORY = 10
"""Generations over which the strategy's mean is averaged, exponentially."""

PARTS = 8
"""A suite's training episodes come in so many parts, one a generation in turn; interruptions, being exact, in one."""
PART_EPISODES = 12

VALIDATION_EPISODES = 3 * EPISODES
VALIDATION_SEED = 1

MODEL = "model.safetensors"


def yards(arguments: Arguments, split: str, seed: int, episodes: int = EPISODES, parts: int = 1) -> list[Yard]:
    """Grounds of every suite, drawn from ``seed``: ``parts`` times so many episodes, or the exact ones."""
    given = arguments.capacities, arguments.data or None, split, seed, episodes, parts
    return [_yard(suite, *given) for suite in arguments.suites]


@functools.lru_cache(maxsize=32)  # bounds take a minute, and several agents may be made in one process (the ablation)
def _yard(
    suite: str, given_capacities: str, data: str | None, split: str, seed: int, episodes: int, parts: int
) -> Yard:
    capacities = capacities_of(suite, given_capacities)
    given = cells(suite, split, capacities, data)
    if not given_capacities:
        small = [L for L in SMALL if L not in capacities]
        given += [c for c in cells(suite, split, small, data) if isinstance(c.scenario, Interruption)]
    sampled = parts if any(isinstance(cell.scenario, Uplink) for cell in given) else 1
    return Yard(*(grounds(given, seed + 1000 * k, episodes) for k in range(sampled)))


# --- weights as a vector ---------------------------------------------------------------------------------------------


def fields_of(arguments: Arguments) -> tuple[str, ...]:
    """What the agent reads."""
    fields = tuple(arguments.fields.split(",")) if arguments.fields else SEES[arguments.sees]
    known = [name for name in fields if name in learned.NAMES]
    if len(set(known)) < len(fields) or not {"motion_merged", "time_merged"} & set(known) or "rank" not in known:
        raise BufgymError(
            f"fields = {arguments.fields!r}: must be rank, motion_merged or time_merged, and others of the "
            "observation's, each once (bufgym list observations)"
        )
    return fields


def start(fields: tuple[str, ...], width: int, rng: np.random.Generator) -> Weights:
    """Drop what leaves the smallest merged gap (of motion, where it is seen), rather old than new; accept with room."""
    made = learned.random_weights(fields, (width,) if width else (), rng)
    seen = "motion_merged" if "motion_merged" in fields else "time_merged"
    made.drop.skip[fields.index(seen)] = -10.0
    made.drop.skip[fields.index("rank")] = -0.4
    made.accept.bias[0] = 5.0
    return replace(made, mix=np.zeros((len(made.context), len(made.slot)), np.float32))


def searched(given: Weights) -> NDArray[np.bool_]:
    """bool[numbers]: those to be searched, in the order of ``numbers``.

    What the context and the bias add to every drop alike, the acceptance can take off; and it stays linear.
    """
    drop, accept = np.ones(len(given.drop.flat()), np.bool_), np.zeros(len(given.accept.flat()), np.bool_)
    inputs = len(given.fields)
    drop[:inputs] = [name in given.slot for name in given.fields]
    drop[inputs] = False
    accept[: inputs + 1] = True
    return np.concatenate([drop, accept, np.ones(_mixing(given).size, np.bool_)])


def to_vector(given: Weights) -> NDArray[np.float64]:
    """The numbers to be searched, in a row."""
    return numbers(given)[searched(given)]


def numbers(given: Weights) -> NDArray[np.float64]:
    """All numbers of both networks and of the mixing."""
    return np.concatenate([given.drop.flat(), given.accept.flat(), _mixing(given).reshape(-1)])


def from_vector(like: Weights, vector: NDArray[np.float64]) -> Weights:
    """The weights that those numbers are; all others are those of ``like``."""
    flat = numbers(like)
    flat[searched(like)] = vector
    networks = len(like.drop.flat())
    drop, accept, mix = np.split(flat, [networks, 2 * networks])
    mixing = mix.reshape(_mixing(like).shape).astype(np.float32)
    return Weights(like.fields, _network(like.drop, drop), _network(like.accept, accept), mixing, like.still)


def _mixing(given: Weights) -> NDArray[np.float32]:
    assert given.mix is not None
    return given.mix


def _network(like: Network, flat: NDArray[np.float64]) -> Network:
    shapes = [like.skip.shape, (1,), *(a.shape for layer in like.layers for a in layer), like.out.shape]
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    skip, bias, *layers, out = (
        part.reshape(shape).astype(np.float32) for part, shape in zip(np.split(flat, ends[:-1]), shapes, strict=True)
    )
    return Network(skip, bias, tuple(zip(layers[::2], layers[1::2], strict=True)), out)


# --- training --------------------------------------------------------------------------------------------------------


@dataclass
class Search:
    """Where a seed's evolution stands; what a checkpoint holds."""

    like: Weights
    """What is not searched has these numbers."""
    still: bool
    """Whether the scorer for links that stand still is searched, or the one for all others (or for all)."""
    es: Any
    """pycma's strategy."""
    average: NDArray[np.float64]
    """Of the strategy's latest means (``MEMORY``), which the luck of single parts moves about: this is the agent."""
    steps: int = 0
    generations: int = 0
    seconds: float = 0.0

    @staticmethod
    def of(like: Weights, still: bool, seed: int, **before: Any) -> Search:
        """A new one, around these weights; ``still`` searches those of their second scorer."""
        begin = to_vector(like.still if still and like.still else like)
        settings = {"seed": seed + 1, "popsize": POPULATION, "verbose": -9, "CMA_diagonal": len(begin) > DIAGONAL}
        return Search(like, still, cma.CMAEvolutionStrategy(begin, SIGMA[still], settings), begin, **before)

    def weights(self, vector: NDArray[np.float64]) -> Weights:
        if self.still and self.like.still:
            return replace(self.like, still=from_vector(self.like.still, vector))
        return from_vector(self.like, vector)

    @property
    def mean(self) -> Weights:
        """The agent so far."""
        return self.weights(self.average)

    def generation(self, yards: Sequence[Yard]) -> float:
        """Ask, try and tell once; the best fitness."""
        vectors = self.es.ask()
        part = self.generations
        fitness = [_fitness(learned.policy("evolved", self.weights(v)), yards, part) for v in vectors]
        self.es.tell(vectors, fitness)
        self.average = self.average + (self.es.mean - self.average) / MEMORY
        self.steps += sum(yard.decisions(part) for yard in yards) * len(vectors)
        self.generations += 1
        return float(np.min(fitness))


def train(
    arguments: Arguments, folder: Path, seed: int, line: int = 0
) -> tuple[float, list[tuple[float, ...]], list[tuple[float, ...]]]:
    """Evolve one seed until ``arguments.steps`` decisions were rolled out, from its last checkpoint if there is one.

    What did best on validation, by the same measure on other episodes, is kept as ``model.safetensors``. For the first
    ``arguments.warm_up`` decisions the scorer for links that stand still is learned.

    Returns:
        Seconds of training, the learning curve (steps, seconds, fitness), and the validations (steps, seconds,
        *Verdict, the fitness on validation).
    """
    if not arguments.suite:
        raise BufgymError("--algo evolution learns from a suite's episodes: name one (--suite)")
    given = [cell for suite in arguments.suites for cell in cells(suite, "train", (1,), arguments.data or None)]
    if arguments.warm_up and not any(isinstance(cell.scenario, Interruption) for cell in given):
        raise BufgymError(f"warm_up = {arguments.warm_up}: needs a suite of interruptions")
    home = folder / f"seed-{seed}"
    home.mkdir(exist_ok=True)
    saved = home / "evolution.pkl"  # one's own run alone: pickles run code when they are read
    everything = yards(arguments, "train", seed, PART_EPISODES, PARTS)
    judges = yards(arguments, "validation", VALIDATION_SEED, VALIDATION_EPISODES)
    trials = ValidationSet(arguments, folder)
    like, warm_up = start(fields_of(arguments), arguments.hidden, np.random.default_rng(seed)), arguments.warm_up > 0
    still, moving = everything, everything
    if warm_up:
        like = replace(like, still=start(like.fields, arguments.still_hidden, np.random.default_rng(seed)))
        still = [yard for yard in everything if yard.exact]
        moving = [yard for yard in everything if not yard.exact] or everything
    search = pickle.loads(saved.read_bytes()) if saved.exists() else Search.of(like, warm_up, seed)
    curve = Record(home / "curve.csv", ("steps", "seconds", "fitness"), search.steps)
    validations = Record(home / "validation.csv", ("steps", "seconds", *Verdict._fields, "over_rivals"), search.steps)
    began = time.perf_counter() - search.seconds

    def validate(made: Weights) -> None:
        policy = learned.policy("evolved", made)
        verdict, reached = trials.verdict_on(policy), _fitness(policy, judges)
        if not validations.rows or reached < min(row[-1] for row in validations.rows):
            noted = {"name": "evolved", "suite": arguments.suite, "seeds": [seed], "algo": "evolution"}
            weights.save(home / MODEL, made, noted)
        validations.append(search.steps, _since(began), *verdict, reached)
        if not sys.stderr.isatty():
            told = f"{search.steps:,} of {arguments.steps:,} steps, regret {reached:.3f} x the rivals' on validation"
            print(f"seed {seed}: {told}", flush=True)

    bar = seed_bar(arguments.steps, search.steps, seed, line)
    if not validations.rows:
        validate(search.mean)
    while search.steps < arguments.steps:
        if search.still and search.steps >= arguments.warm_up:
            # From what did best on validation, as a scorer of interruptions alone may come to fail elsewhere.
            search = Search.of(weights.read(home / MODEL)[0], False, seed, steps=search.steps)
        fitness = search.generation(still if search.still else moving)
        search.seconds = _since(began)
        curve.append(search.steps, search.seconds, fitness)
        if search.steps - validations.rows[-1][0] >= arguments.validate_every or search.steps >= arguments.steps:
            validate(search.mean)
        with replaced(saved) as unfinished:
            unfinished.write_bytes(pickle.dumps(search))
        bar.update(search.steps - bar.n)
        bar.set_postfix_str(f"regret {validations.rows[-1][-1]:.3f} x the rivals' on validation", refresh=False)
    bar.close()
    return search.seconds, curve.rows, validations.rows


def _since(began: float) -> float:
    return float(round(time.perf_counter() - began, 3))


def _fitness(policy: Policy, yards: Sequence[Yard], part: int | None = None) -> float:
    return float(np.mean([yard.over_rivals(policy, part) for yard in yards]))
