"""Learning from the clairvoyant: a network on slots finds what each of its own decisions cost, as hindsight tells.

The student plays. In every state that it reaches, the clairvoyant says how much of H each action would have given up
for good, its *regret*. The student then lowers its mean regret, sum_a p(a) regret(a), by gradient steps on all states
so far. That needs no critic, no discount and no exploration. By the performance difference lemma the regrets of an
episode add up to what the student lost of it. This is AggreVaTe [ross2014reinforcement], with a clairvoyant oracle as
in [choudhury2018data].

A student that plays badly sees bad states alone. One that rejects all it can sees no harm in it there, as the
clairvoyant could still mend everything in the next moment. Four things keep it from there:

- It begins as the rule ``gap-price``: a network of zeros, added to ``PRIOR`` for what the rule chooses. It never
  rejects at an idle socket (``IDLE``).
- It learns once it has seen states of many episodes. Its rows are at different moments of theirs.
- The best student so far, by whole training episodes, is the *leader*. Leader and rule play a part of the rows, as in
  DAgger's mixture [ross2011reduction], so good states never end, and a student that fell finds its way back.
- Students are running means of the weights. The leader is what validation judges, so what is kept never falls.
"""

from __future__ import annotations

import copy
import math
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from agents.held_out import split_scenario
from agents.hindsight_network import CONTEXT, SLOT, Student, mean_regret
from agents.learner import Learner
from agents.mixed_env import Cell, cells
from agents.runs import MODEL, Record, Run, Validations, seed_bar
from agents.settings import Hindsight
from bufgym.envs import SenderVectorEnv, expert
from bufgym.envs.expert.player import Player
from bufgym.ground.files import replaced
from bufgym.policies import learned, weights
from bufgym.policies.learned import Weights

ACCEPTS, DROPS = CONTEXT.index("rule_accepts"), SLOT.index("rule_drops")
MEAN = 0.995
"""Weight of the past in the running mean of the weights, at each gradient step."""
LEAST_RATE = 0.05
"""The learning rate at the end, beside that at the start."""
REGRET = 100.0
"""Factor on the regrets: Adam's least step is then far below any gradient."""
FIRST = 16_384
"""Decisions before the first gradient step."""
CHECK = 10_000
"""Decisions from one comparison with the leader to the next."""
CURVE = 32
"""Updates from one row of the curve to the next."""


class Lesson(NamedTuple):
    """Decisions, and what the clairvoyant says of them."""

    slots: NDArray[np.float32]
    """float32[n, L + 1, slot fields]; the newcomer is last."""
    context: NDArray[np.float32]
    """float32[n, context fields]"""
    regret: NDArray[np.float32]
    """float32[n, L + 2]; infinite for invalid actions."""


class Lessons:
    """All lessons so far, up to so many; then new ones take the places of others at random."""

    def __init__(self, room: int, capacity: int) -> None:
        shapes = (capacity + 1, len(SLOT)), (len(CONTEXT),), (capacity + 2,)
        self._all = Lesson(*(np.zeros((room, *shape), np.float32) for shape in shapes))
        self.room, self.count = room, 0

    def add(self, lesson: Lesson, rng: np.random.Generator) -> None:
        """Keep these."""
        n = len(lesson.context)
        places = np.arange(self.count, self.count + n)
        if self.count + n > self.room:
            places = rng.integers(self.room, size=n)
        self.count = min(self.count + n, self.room)
        for kept, new in zip(self._all, lesson, strict=True):
            kept[places] = new

    def draw(self, size: int, rng: np.random.Generator) -> list[Tensor]:
        """So many at random: slots, context, regret."""
        places = rng.integers(self.count, size=size)
        return [torch.from_numpy(kept[places]) for kept in self._all]


class Rows:
    """n environments of one cell, each played by the rule, the leader or the student.

    Args:
        cell: the links and L.
        n: rows.
        start: the weights at which all begin.
        shares: of the rows, those that the rule and the leader play.
        rng: for episodes, and for who plays which row.
    """

    def __init__(
        self, cell: Cell, n: int, start: Weights, shares: tuple[float, float], rng: np.random.Generator
    ) -> None:
        self.env = SenderVectorEnv(
            n,
            cell.scenario,
            cell.capacity,
            decide_at="arrival",
            autoreset_mode="SameStep",
            info="mask",
            actions="slots",
        )
        self.env.reset(seed=int(rng.integers(2**31)))
        self._senders, self._start, self.capacity = self.env.rows.senders, start, cell.capacity
        self._clairvoyant = expert.clairvoyant(self.env)
        place = (rng.permutation(n) + rng.random()) / n
        self._ruled = place < shares[0]
        led = place < sum(shares)
        self._players = [(Player(start.policy("player"), n), np.flatnonzero(who)) for who in (led, ~led)]

    def _observe(self, *weights: Weights) -> tuple[NDArray[np.int64], Lesson]:
        """Everyone's actions, and what is seen, by the weights of leader and student; no regrets yet."""
        n, L = self.env.num_envs, self.capacity
        actions = np.zeros(n, np.int64)
        shapes = (n, L + 1, len(SLOT)), (n, len(CONTEXT)), (n, L + 2)
        seen = Lesson(*(np.zeros(shape, np.float32) for shape in shapes))
        for (player, rows), now in zip(self._players, weights, strict=True):
            if len(rows):
                player.rewrite(now.parameters())
                actions[rows] = player.actions(self._senders, rows)[rows]
                context, slots = learned.seen(player.memory[rows], self._start, L)
                seen.context[rows], seen.slots[rows] = context, slots
        drops = np.where(seen.slots[:, -1, DROPS] > 0, L, seen.slots[:, :-1, DROPS].argmax(axis=1))
        ruled = np.where(seen.context[:, ACCEPTS] > 0, L + 1, drops)
        return np.where(self._ruled, ruled, actions), seen

    def scatter(self, longest: int, rng: np.random.Generator) -> None:
        """Let the rule play until rows are at different moments of their episodes."""
        begin = rng.integers(longest, size=self.env.num_envs)
        for moment in range(longest):
            self.env.step(self._observe(self._start, self._start)[0])
            if (begin == moment).any():
                self.env.reset(options={"reset_mask": begin == moment})

    def step(self, leader: Weights, student: Weights) -> Lesson:
        """Play one decision in every row."""
        actions, seen = self._observe(leader, student)
        regret = self._clairvoyant.regrets()
        seen.regret[:] = np.where(np.isnan(regret), np.inf, regret)
        self.env.step(actions)
        return seen


def padded(lesson: Lesson, capacity: int) -> Lesson:
    """The lesson with ``capacity`` slots: the newcomer and the last two actions stay last."""
    missing = capacity + 1 - lesson.slots.shape[1]
    if not missing:
        return lesson
    at = lesson.slots.shape[1] - 1
    slots = np.insert(lesson.slots, [at] * missing, 0, axis=1)
    return Lesson(slots, lesson.context, np.insert(lesson.regret, [at] * missing, np.inf, axis=1))


class School:
    """The state of one seed's learning, as in a checkpoint."""

    def __init__(self, settings: Hindsight, seconds: float) -> None:
        self.settings, self.longest = settings, seconds
        self.student = Student(settings.width)
        """The latest weights."""
        self.mean, self.leader = copy.deepcopy(self.student), copy.deepcopy(self.student)
        """Their running mean, which plays; and the best such mean."""
        self.optimizer = torch.optim.Adam(self.student.parameters(), settings.learning_rate)
        self.steps, self.seconds = 0, 0.0
        self.best = math.inf
        """Fitness of the leader, the less the better."""

    def learn(self, lessons: Sequence[Tensor]) -> float:
        """Make one gradient step; return the mean regret."""
        left = 1 - max(self.steps / self.settings.steps, self.seconds / self.longest)
        for group in self.optimizer.param_groups:
            group["lr"] = self.settings.learning_rate * max(LEAST_RATE, left)
        slots, context, regret = lessons
        loss = mean_regret(self.student(slots, context), regret)
        self.optimizer.zero_grad()
        (REGRET * loss).backward()  # type: ignore[no-untyped-call]
        self.optimizer.step()
        with torch.no_grad():
            for average, latest in zip(self.mean.parameters(), self.student.parameters(), strict=True):
                average.lerp_(latest, 1 - MEAN)
        return float(loss.detach())

    def compare(self, fitness: Callable[[Weights], float]) -> None:
        """Let the student lead if it is the best so far."""
        now = fitness(self.mean.weights())
        if now <= self.best:
            self.leader, self.best = copy.deepcopy(self.mean), now

    def save(self, path: Path) -> None:
        """Write the state, whole or not at all."""
        state = {name: getattr(self, name).state_dict() for name in self.PARTS}
        with replaced(path) as unfinished:
            torch.save({**state, **{name: getattr(self, name) for name in self.NUMBERS}}, unfinished)

    def load(self, path: Path) -> None:
        """Read the state; no code is run."""
        state = torch.load(path, weights_only=True)
        for name in self.PARTS:
            getattr(self, name).load_state_dict(state[name])
        for name in self.NUMBERS:
            setattr(self, name, state[name])

    PARTS = ("student", "mean", "leader", "optimizer")
    NUMBERS = ("steps", "seconds", "best")


class HindsightLearner(Learner[Hindsight]):
    """Imitation of the clairvoyant by what each action costs."""

    def cells(self) -> list[Cell]:
        """The links to learn on, each at each L."""
        on, chosen = self.settings.environment, self.settings.suites
        if self.settings.kind == "environment":
            return [Cell("", split_scenario(on)[0], on.capacity)]
        return [c for suite in chosen.suite for c in cells(suite, "train", chosen.capacities_of(suite), chosen.data)]

    def train_seed(self, folder: Path, seed: int, line: int = 0) -> Run:
        """Train one seed; a resumed one has its state of learning, and begins to collect anew."""
        torch.set_num_threads(1)
        settings, home = self.settings, folder / f"seed-{seed}"
        home.mkdir(exist_ok=True)
        objective, checkpoint = self.objective(folder, seed), home / "hindsight.pt"
        torch.manual_seed(seed)
        school = School(settings, self.seconds)
        if checkpoint.exists():
            school.load(checkpoint)
        # Every session has a seed of its own, by its first step: the episodes before a kill do not come again.
        rng = np.random.default_rng([seed, school.steps])
        mixed = self.cells()
        n, L = math.ceil(settings.num_envs / len(mixed)), max(cell.capacity for cell in mixed)
        shares = settings.rule_share, (1 - settings.rule_share) * settings.leader_share
        start, lessons = Student(settings.width).weights(), Lessons(settings.room, L)
        groups = [Rows(cell, n, start, shares, rng) for cell in mixed]
        curve = Record(home / "curve.csv", ("steps", "seconds", "regret"), school.steps)
        validations = Validations(home, objective.columns, objective.best, settings, school.steps)
        bar = seed_bar(settings.steps, school.steps, seed, line)
        before, began, saved, checked = school.seconds, time.perf_counter(), school.steps, school.steps
        if school.steps < settings.steps:
            for rows in groups:
                rows.scatter(rows.env.rows.senders.batch.arrivals.shape[1], rng)
        while True:
            ended = school.steps >= settings.steps or school.seconds >= self.seconds
            if ended or school.steps - checked >= CHECK or school.best == math.inf:
                checked = school.steps
                school.compare(lambda agent: objective.fitness(agent.policy(objective.name), 0))
            if validations.due(school.steps, last=ended):
                agent = school.leader.weights()
                measures = objective.validate(agent.policy(objective.name))
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
            playing = school.leader.weights(), school.mean.weights()
            for rows in groups:
                lessons.add(padded(rows.step(*playing), L), rng)
            school.steps += n * len(groups)
            if lessons.count >= min(FIRST, settings.room):
                for _ in range(settings.gradient_steps):
                    regret = school.learn(lessons.draw(settings.batch_size, rng))
                if school.steps % (CURVE * n * len(groups)) == 0:
                    curve.append(school.steps, school.seconds, regret)
            school.seconds = round(before + time.perf_counter() - began, 3)
            bar.update(school.steps - bar.n)
        bar.close()
        return Run(seed, home, school.seconds, curve.rows, validations.rows, MODEL, objective.best)
