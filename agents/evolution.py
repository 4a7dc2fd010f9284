"""Evolution: a slot scorer's weights by CMA-ES over whole episodes, rolled out in compiled code.

PPO learns from decisions one by one and pays for its updates; here a candidate is a vector of weights, its fitness the
regret of whole episodes against the clairvoyant over AFR's, averaged over *cells* (scenario, V, L). A rollout decides
a million times a second, so a few minutes suffice. The episodes stay the same throughout: candidates then differ by
what they decide alone (common random numbers), and validation episodes say when to stop. The optimiser is pycma
(Hansen, The CMA Evolution Strategy: A Tutorial, arXiv 1604.00772).

The search begins at what is known to be good: drop what leaves the smallest merged gap, accept where there is room.
"""

from __future__ import annotations

import pickle
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import cma
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from agents.callbacks import Record
from agents.trials import Verdict, validation_of
from agents.worlds import Cell, capacities_of, cells
from bufgym import policies
from bufgym.benchmark import campaign
from bufgym.benchmark.run import best, draw, regret
from bufgym.errors import BufgymError
from bufgym.files import replaced
from bufgym.policies import Policy, learned, weights
from bufgym.policies.learned import Network, Weights
from bufgym.scenario import Scenario, Uplink
from bufgym.sender import Senders

if TYPE_CHECKING:
    from train import Arguments

TIME = (
    *("rank", "time_before", "time_merged"),
    *("occupancy", "arrival_time_gap", "busy", "left", "stalled", "departures", "drain"),
)
"""What a queue and a clock can tell, as AFR's."""

MOTION = (*TIME, "motion_before", "motion_merged", "loss", "arrival_motion_gap")
"""With odometry, and the V that is aimed at."""

SEES = {"time": TIME, "motion": MOTION}

POPULATION = 16
SIGMA = 0.2
"""First step size; the start's weights are of the order of 10."""

AFR_AT_LEAST = 0.003
"""A cell where AFR's regret is smaller counts as if it were this: there is next to nothing to be gained."""
WORST = 3.0
"""No cell counts more than so many times AFR's regret."""


INTERRUPTIONS, UPLINKS = 60, 6
"""Episodes a cell."""

MODEL = "model.safetensors"


@dataclass
class Ground:
    """Episodes of one cell with their bounds, ready to be rolled out again and again."""

    label: str
    scenario: Scenario
    senders: Senders
    best: float
    """Sum of H of the clairvoyant."""
    afr: float = field(default=np.nan)
    """AFR's regret here."""

    @staticmethod
    def of(label: str, scenario: Scenario, capacity: int, drawn: Sequence[tuple[int, int]]) -> Ground:
        """The episodes of these (trace, seed)."""
        episodes = [draw(campaign.cell(scenario, trace), seed) for trace, seed in drawn]
        senders = Senders(len(episodes), capacity, scenario.value, max_messages=scenario.max_messages)
        for i, episode in enumerate(episodes):
            senders.load(i, episode)
        made = Ground(label, scenario, senders, sum(best(episode, capacity, scenario).qoi for episode in episodes))
        made.afr = made.regret(policies.get("afr"))
        return made

    def regret(self, policy: Policy) -> float:
        """1 - sum H / sum H of the clairvoyant."""
        for i, episode in enumerate(self.senders.episodes):
            assert episode is not None
            self.senders.load(i, episode)
        self.senders.run(policy)
        delivered = self.senders.batch.senders
        got = float((delivered["delivered_gain"] + (delivered["crossed"] > 0)).sum())
        return regret(got, self.best)

    def over_afr(self, policy: Policy) -> float:
        """The policy's regret over AFR's, WORST at most."""
        return min(WORST, self.regret(policy) / max(self.afr, AFR_AT_LEAST))


def grounds(given: Sequence[Cell], seed: int) -> list[Ground]:
    """Training episodes of every cell; its traces are taken in turn."""
    rng = np.random.default_rng(seed)
    made = []
    for label, scenario, capacity in given:
        traces = len(scenario.traces) if isinstance(scenario, Uplink) else 1
        count = UPLINKS if isinstance(scenario, Uplink) else INTERRUPTIONS
        order = rng.permutation(np.resize(rng.permutation(traces), count))
        made.append(Ground.of(label, scenario, capacity, [(int(k), int(rng.integers(10**6))) for k in order]))
    return made


# --- weights as a vector ---------------------------------------------------------------------------------------------


def start(fields: tuple[str, ...], width: int, rng: np.random.Generator) -> Weights:
    """Drop what leaves the smallest merged gap (of motion, where it is seen); accept where there is room."""
    made = learned.random_weights(fields, (width,) if width else (), rng)
    seen = "motion_merged" if "motion_merged" in fields else "time_merged"
    made.drop.skip[fields.index(seen)] = -10.0
    made.accept.bias[0] = 5.0
    return made


def to_vector(given: Weights) -> NDArray[np.float64]:
    """All numbers of both networks in a row."""
    return np.concatenate([given.drop.flat(), given.accept.flat()])


def from_vector(like: Weights, vector: NDArray[np.float64]) -> Weights:
    """The weights that those numbers are, in the shape of ``like``."""
    drop, accept = np.split(vector, [len(like.drop.flat())])
    return Weights(like.fields, _network(like.drop, drop), _network(like.accept, accept))


def _network(like: Network, flat: NDArray[np.float64]) -> Network:
    shapes = [like.skip.shape, (1,), *(a.shape for layer in like.layers for a in layer), like.out.shape]
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    skip, bias, *layers, out = (
        part.reshape(shape).astype(np.float32) for part, shape in zip(np.split(flat, ends[:-1]), shapes, strict=True)
    )
    return Network(skip, bias, tuple(zip(layers[::2], layers[1::2], strict=True)), out)


# --- training --------------------------------------------------------------------------------------------------------


def train(
    arguments: Arguments, folder: Path, seed: int, line: int = 0
) -> tuple[float, list[tuple[float, ...]], list[tuple[float, ...]]]:
    """Evolve one seed until ``arguments.steps`` decisions were rolled out, from its last checkpoint if there is one.

    What did best on validation is kept as ``model.safetensors``.

    Returns:
        Seconds of training, the learning curve (steps, seconds, fitness), and the validations (steps, seconds,
        *Verdict).
    """
    if not arguments.suite:
        raise BufgymError("--algo evolution learns from a suite's episodes: name one (--suite)")
    home = folder / f"seed-{seed}"
    home.mkdir(exist_ok=True)
    saved = home / "evolution.pkl"  # one's own run alone: pickles run code when they are read
    capacities, data = capacities_of(arguments.suite, arguments.capacities), arguments.data or None
    ground = grounds(cells(arguments.suite, "train", capacities, data), seed)
    like = start(SEES[arguments.sees], arguments.hidden, np.random.default_rng(seed))
    if saved.exists():
        es, steps, before = pickle.loads(saved.read_bytes())
    else:
        settings = {"seed": seed + 1, "popsize": POPULATION, "verbose": -9}
        es, steps, before = cma.CMAEvolutionStrategy(to_vector(like), SIGMA, settings), 0, 0.0
    decisions = sum(int(g.senders.batch.senders["arrivals"].sum()) for g in ground)
    trials = validation_of(arguments, folder)
    curve = Record(home / "curve.csv", ("steps", "seconds", "fitness"), steps)
    validations = Record(home / "validation.csv", ("steps", "seconds", *Verdict._fields), steps)
    began = time.perf_counter()

    def spent() -> float:
        return float(round(before + time.perf_counter() - began, 3))

    def validate(vector: NDArray[np.float64]) -> None:
        made = from_vector(like, vector)
        verdict = trials.verdict_on(learned.policy("evolved", made))
        if not validations.rows or verdict.score > max(row[2] for row in validations.rows):
            noted = {"name": "evolved", "suite": arguments.suite, "seeds": [seed], "algo": "evolution"}
            weights.save(home / MODEL, made, noted)
        validations.append(steps, spent(), *verdict)
        if not sys.stderr.isatty():
            told = f"{steps:,} of {arguments.steps:,} steps, regret {verdict.over_afr:.3f} x AFR's on validation"
            print(f"seed {seed}: {told}", flush=True)

    bar = tqdm(
        total=arguments.steps,
        initial=steps,
        desc=f"seed {seed}",
        unit=" steps",
        unit_scale=True,
        position=line,
        disable=not sys.stderr.isatty(),
    )
    if not validations.rows:
        validate(es.mean)
    while steps < arguments.steps:
        vectors = es.ask()
        fitness = [_fitness(learned.policy("evolved", from_vector(like, v)), ground) for v in vectors]
        es.tell(vectors, fitness)
        steps += decisions * len(vectors)
        curve.append(steps, spent(), float(np.min(fitness)))
        if steps - validations.rows[-1][0] >= arguments.validate_every or steps >= arguments.steps:
            validate(es.mean)
        with replaced(saved) as unfinished:
            unfinished.write_bytes(pickle.dumps((es, steps, spent())))
        bar.update(steps - bar.n)
        bar.set_postfix_str(f"regret {validations.rows[-1][4]:.3f} x AFR's on validation", refresh=False)
    bar.close()
    return spent(), curve.rows, validations.rows


def _fitness(policy: Policy, ground: Sequence[Ground]) -> float:
    return float(np.mean([g.over_afr(policy) for g in ground]))
