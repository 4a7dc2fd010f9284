"""Learning from the clairvoyant: a network among ordered candidates finds what its own decisions cost in hindsight.

The student plays. In every state that it reaches, the clairvoyant says how much of H each action would have given up
for good, its *cost*. The student then lowers its mean cost, sum_a p(a) cost(a), by gradient steps on all states so far.
That needs no critic, no discount and no exploration. By the performance difference lemma the costs of an episode add up
to what the student lost of it. This is AggreVaTe [ross2014reinforcement], with a clairvoyant oracle as in
[choudhury2018data].

Costs are counted in units of what action 0 costs on average, "accept where there is room, else drop the cheapest". So
families of links, whose regrets differ a hundredfold, are learned side by side. Four things keep a student from states
where it sees no harm in bad habits, as the clairvoyant could still mend everything in the next moment:

- It begins at action 0, which plays a sixth of the rows to the end.
- It learns once it has seen states of many episodes. Its rows are at different moments of theirs.
- A softmax that has given an action up learns no more of it. On families and suites a bonus for entropy, which falls to
  0 by half time, keeps it from that. On one task the bonus did not suffice: two actions mostly decide the same, and
  the network ended on these. So there the student learns the order of its actions, by pairs (``ranked``), without
  a bonus. On all families side by side pairs were worse: half through a training they left .66 of AFR's regret on
  recorded uplinks in validation, the expected cost .58.
- The running mean of its weights plays, and is what validation judges.
"""

from __future__ import annotations

import math
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from agents.held_out import split_scenario
from agents.hindsight_network import Student, expected, ranked
from agents.hindsight_rows import Lessons, Part, TaughtRows
from agents.learner import Learner
from agents.mixed_env import Cell, cells
from agents.ready_families import FAMILIES
from agents.runs import MODEL, Record, Run, Validations, seed_bar
from agents.settings import Hindsight
from bufgym.policies import weights
from bufgym.policies.candidate_network import CandidateWeights
from bufgym.utils.errors import BufgymError
from bufgym.utils.files import replaced

MEAN = 0.995
"""Weight of the past in the running mean of the weights, at each gradient step."""
LEAST_RATE = 0.05
"""The learning rate at the end, beside that at the start."""
FIRST = 8_192
"""Decisions before the first gradient step."""
EQUAL = 0.5
"""Share of a batch that families have in equal parts; the rest goes by what they still lose."""
WAITED = 300
"""Decisions of every row within which each family must have had a lesson."""
LOST = 0.99
"""Weight of the past in a family's mean loss, at each gradient step."""
TOLD = 1 / 3
"""Share of a family's rows that are told when their stream ends."""
CURVE = 32
"""Steps of all rows from one row of the curve to the next."""


def told(cell: Cell) -> list[Cell]:
    """The same with a robot that is told when its stream ends; empty where none can be."""
    scenario: Any = cell.scenario
    return (
        [cell._replace(scenario=replace(scenario, tells_duration=True))] if hasattr(scenario, "tells_duration") else []
    )


class School:
    """The state of one seed's learning, as in a checkpoint."""

    def __init__(self, settings: Hindsight, families: int, seconds: float) -> None:
        self.settings, self.longest = settings, seconds
        self.student = Student(settings.candidates, settings.width)
        """The latest weights."""
        average = get_ema_multi_avg_fn(MEAN)  # type: ignore[no-untyped-call]
        self.mean = AveragedModel(self.student, multi_avg_fn=average)
        """Their running mean, which plays."""
        self.optimizer = torch.optim.Adam(self.student.parameters(), settings.learning_rate, fused=True)
        self.steps, self.seconds = 0, 0.0
        self.lost = [1.0] * families
        """Each family's mean cost of late, in units of what action 0 costs."""

    @property
    def left(self) -> float:
        """The part of the training that is left."""
        return 1 - max(self.steps / max(self.settings.steps, 1), self.seconds / self.longest)

    def choose(self, shown: NDArray[np.float32], offered: NDArray[np.bool_]) -> NDArray[np.int64]:
        """The running mean's best actions."""
        with torch.inference_mode():
            outputs: NDArray[np.float32] = self.mean(torch.from_numpy(shown)).numpy()
        return np.asarray(np.argmax(np.where(offered, outputs, -np.inf), axis=1), np.int64)

    def sizes(self) -> NDArray[np.int64]:
        """int64[families]: states of each in a batch; families that lose more have more."""
        lost = np.array(self.lost)
        shares = EQUAL / len(lost) + (1 - EQUAL) * lost / lost.sum()
        return np.asarray(np.maximum(1, np.round(shares * self.settings.batch_size)), np.int64)

    def learn(self, shown: Tensor, cost: Tensor, sizes: NDArray[np.int64]) -> float:
        """Make one gradient step on states of families of these ``sizes``; return the mean loss of the families."""
        left = max(self.left, 0.0)
        for group in self.optimizer.param_groups:
            group["lr"] = self.settings.learning_rate * max(LEAST_RATE, left)
        outputs = self.student(shown)
        costs, entropy = expected(outputs, cost)
        if self.settings.kind == "environment":
            loss = ranked(outputs, cost).mean()
        else:
            loss = costs.mean() - self.settings.entropy * max(0.0, 2 * left - 1) * entropy.mean()
        self.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.student.parameters(), 1.0)
        self.optimizer.step()
        self.mean.update_parameters(self.student)
        now = np.add.reduceat(costs.detach().numpy(), np.cumsum([0, *sizes[:-1]])) / sizes
        self.lost = [LOST * before + (1 - LOST) * float(own) for before, own in zip(self.lost, now, strict=True)]
        return float(now.mean())

    def weights(self) -> CandidateWeights:
        """The running mean, as in a file."""
        averaged: Any = self.mean.module
        found: CandidateWeights = averaged.weights()
        return found

    def save(self, path: Path) -> None:
        """Write the state, whole or not at all."""
        state: dict[str, Any] = {name: getattr(self, name).state_dict() for name in self.PARTS}
        with replaced(path) as unfinished:
            torch.save({**state, **{name: getattr(self, name) for name in self.NUMBERS}}, unfinished)

    def load(self, path: Path) -> None:
        """Read the state; no code is run."""
        state = torch.load(path, weights_only=True)
        for name in self.PARTS:
            getattr(self, name).load_state_dict(state[name])
        for name in self.NUMBERS:
            setattr(self, name, state[name])

    PARTS = ("student", "mean", "optimizer")
    NUMBERS = ("steps", "seconds", "lost")


class HindsightLearner(Learner[Hindsight]):
    """Imitation of the clairvoyant by what each action costs."""

    def __init__(self, settings: Hindsight, seconds: float = math.inf) -> None:
        super().__init__(settings.resolved, seconds)

    def parts(self) -> list[Part]:
        """Rows of every cell to learn on. A suite is a family too; its cells have about as many rows each."""
        on, chosen, n = self.settings.environment, self.settings.suites, self.settings.num_envs
        if self.settings.kind == "environment":
            return [Part("", Cell("", split_scenario(on)[0], on.capacity), n)]
        found = {name: FAMILIES[name]("train", chosen.data) for name in self.settings.sets.named(chosen.data)}
        found |= {s: cells(s, "train", chosen.capacities_of(s), chosen.data) for s in chosen.names}
        parts = []
        for family, own in found.items():
            knowing = [each for cell in own for each in told(cell)]
            for some, share in ((own, 1 - TOLD * bool(knowing)), (knowing, TOLD)):
                parts += [Part(family, cell, math.ceil(share * n / len(found) / len(some))) for cell in some]
        return parts

    def train_seed(self, folder: Path, seed: int, line: int = 0) -> Run:
        """Train one seed; a resumed one has its state of learning, and begins to collect anew."""
        torch.set_num_threads(1)
        settings, home = self.settings, folder / f"seed-{seed}"
        home.mkdir(exist_ok=True)
        objective, checkpoint = self.objective(folder, seed), home / "hindsight.pt"
        parts = self.parts()
        torch.manual_seed(seed)
        school = School(settings, len({part.family for part in parts}), self.seconds)
        if checkpoint.exists():
            school.load(checkpoint)
        # Every session has a seed of its own, by its first step: the episodes before a kill do not come again.
        rng = np.random.default_rng([seed, school.steps])
        rows = TaughtRows(parts, settings.candidates, rng)
        families = len(rows.families)
        lessons = Lessons(families, settings.room // families, (rows.seen.shape[1], rows.decisions.shape[1]))
        curve = Record(home / "curve.csv", ("steps", "seconds", "loss"), school.steps)
        validations = Validations(home, objective.columns, objective.best, settings, school.steps)
        bar = seed_bar(settings.steps, school.steps, seed, line)
        before, began, first = school.seconds, time.perf_counter(), school.steps
        saved = first
        if school.steps < settings.steps:
            rows.scatter(rng)
        while True:
            ended = school.steps >= settings.steps or school.seconds >= self.seconds
            if validations.due(school.steps, last=ended):
                agent = school.weights()
                measures = objective.validate(agent.policy(settings.algo))
                if validations.add(school.steps, school.seconds, measures):
                    weights.save(home / MODEL, agent, self.notes(seed, settings.algo))
                report = objective.message.format(*measures)
                bar.set_postfix_str(report, refresh=False)
                if not sys.stderr.isatty():
                    print(f"seed {seed}: {school.steps:,} of {settings.steps:,} steps, {report}", flush=True)
            if ended or school.steps - saved >= settings.checkpoint_every:
                saved = school.steps
                school.save(checkpoint)
            if ended:
                break
            lessons.add(rows.step(school.choose), rows.family, rng)
            school.steps += rows.n
            if lessons.counts.sum() >= min(FIRST, settings.room) and lessons.counts.all():
                for _ in range(settings.gradient_steps):
                    sizes = school.sizes()
                    loss = school.learn(*lessons.draw(sizes, rng), sizes)
                if school.steps % (CURVE * rows.n) == 0:
                    curve.append(school.steps, school.seconds, loss)
            elif school.steps - first == rows.n * WAITED and not lessons.counts.all():
                none = ", ".join(name for name, n in zip(rows.families, lessons.counts, strict=True) if not n)
                where = none or "this task"
                raise BufgymError(f"{where}: the rule gap-price alone decides there, so hindsight teaches nothing")
            school.seconds = round(before + time.perf_counter() - began, 3)
            bar.update(school.steps - bar.n)
        bar.close()
        return Run(seed, home, school.seconds, curve.rows, validations.rows, objective.best)
