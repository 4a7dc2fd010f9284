"""Learning from the clairvoyant: a network on slots finds what each of its own decisions cost, as hindsight tells.

The student plays. In every state that it reaches, the clairvoyant says how much of H each action would have given up
for good, its *regret*. The student then lowers its mean regret, sum_a p(a) regret(a), by gradient steps on all states
so far. That needs no critic, no discount and no exploration. By the performance difference lemma the regrets of an
episode add up to what the student lost of it. This is AggreVaTe [ross2014reinforcement], with a clairvoyant oracle as
in [choudhury2018data].

A student that plays badly sees bad states alone, in which much is lost whatever it does. Four things keep it from there:

- It begins as the rule ``gap-price``: a network of zeros, added to ``PRIOR`` for what the rule chooses.
- Its rows are at different moments of their episodes, and some of them are played by the rule.
- Not the student's latest weights play, but their running mean. It is what validation judges, too.
- Validation says which weights are kept.
"""

from __future__ import annotations

import copy
import math
import sys
import time
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from agents.held_out import split_scenario
from agents.learner import Learner
from agents.mixed_env import Cell, cells
from agents.runs import MODEL, Record, Run, Validations, seed_bar
from agents.settings import Hindsight
from bufgym.envs import SenderVectorEnv, expert
from bufgym.envs.expert.player import Player
from bufgym.ground.files import replaced
from bufgym.policies import learned, weights
from bufgym.policies.learned import Network, Weights
from bufgym.policies.rule_fields import RULE_FIELDS, RULE_SLOT_FIELDS

CONTEXT, SLOT = [field.name for field in RULE_FIELDS], [field.name for field in RULE_SLOT_FIELDS]
ACCEPTS, DROPS = CONTEXT.index("rule_accepts"), SLOT.index("rule_drops")
PRIOR = 3.0
"""Score of what the rule chooses, before learning. A larger one hides what the rest is worth."""
SCALE = 10.0
"""The network's output is multiplied by it, so that small steps of few weights reach large scores."""
MEAN = 0.995
"""Weight of the past in the running mean of the weights, at each gradient step."""
LEAST_RATE = 0.05
"""The learning rate at the end, beside that at the start."""
REGRET = 100.0
"""Factor on the regrets: Adam's least step is then far below any gradient."""
FIRST = 2_048
"""Decisions before the first gradient step."""


class Scorer(nn.Module):
    """One network of a slot scorer, with two hidden layers; its output begins at ``prior``'s field alone."""

    def __init__(self, width: int, prior: str) -> None:
        super().__init__()
        inputs = len(CONTEXT) + len(SLOT)
        self.first, self.second, self.out = nn.Linear(inputs, width), nn.Linear(width, width), nn.Linear(width, 1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)
        skip = torch.zeros(inputs)
        skip[[*CONTEXT, *SLOT].index(prior)] = PRIOR
        self.register_buffer("skip", skip)

    def forward(self, slots: Tensor, context: Tensor) -> Tensor:
        """Scores [n, candidates] of ``slots`` [n, candidates, slot fields] in a ``context`` [n, context fields]."""
        c = len(CONTEXT)
        weight = self.first.weight
        # The context's part is the same for all candidates.
        common = nn.functional.linear(context, weight[:, :c], self.first.bias)
        h = torch.relu(nn.functional.linear(slots, weight[:, c:]) + common[:, None])
        h = torch.relu(self.second(h))
        prior = slots @ self.skip[c:] + (context @ self.skip[:c])[:, None]
        return SCALE * self.out(h)[..., 0] + prior

    def network(self) -> Network:
        """The same as numbers."""
        numbers = {name: tensor.detach().numpy() for name, tensor in self.state_dict().items()}
        layers = tuple((numbers[f"{k}.weight"].T.copy(), numbers[f"{k}.bias"].copy()) for k in ("first", "second"))
        scale = np.float32(SCALE)
        return Network(numbers["skip"].copy(), scale * numbers["out.bias"], layers, scale * numbers["out.weight"][0])


class Student(nn.Module):
    """Scores of all L + 2 actions: to drop each slot, to reject, to accept."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.drop, self.accept = Scorer(width, "rule_drops"), Scorer(width, "rule_accepts")

    def forward(self, slots: Tensor, context: Tensor) -> Tensor:
        return torch.cat([self.drop(slots, context), self.accept(slots[:, -1:], context)], dim=1)

    def weights(self) -> Weights:
        """The weights as in a file."""
        return Weights((*CONTEXT, *SLOT), self.drop.network(), self.accept.network())


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
    """n environments of one cell that a student plays, a ``share`` of them left to the rule."""

    def __init__(self, cell: Cell, n: int, student: Weights, share: float, seed: int) -> None:
        self.env = SenderVectorEnv(
            n, cell.scenario, cell.capacity, decide_at="arrival", autoreset_mode="SameStep", info="mask"
        )
        self.env.reset(seed=seed)
        self._senders, self._weights, self.capacity = self.env.rows.senders, student, cell.capacity
        self._player = Player(learned.policy("student", student), n)
        self._clairvoyant = expert.clairvoyant(self.env)
        self._led = np.arange(n) < math.ceil(share * n)

    def _rule(self, slots: NDArray[Any], context: NDArray[Any]) -> NDArray[np.int64]:
        """The rule's actions, by the fields that show them."""
        drops = np.where(slots[:, -1, DROPS] > 0, self.capacity, slots[:, :-1, DROPS].argmax(axis=1))
        return np.where(context[:, ACCEPTS] > 0, self.capacity + 1, drops)

    def _observe(self, student: Weights) -> tuple[NDArray[np.int64], NDArray[Any], NDArray[Any]]:
        """The student's actions, and the slots and context that it sees."""
        self._player.rewrite(student.parameters())
        actions = self._player.actions(self._senders)
        context, slots = learned.seen(self._player.memory, self._weights, self.capacity)
        return actions, slots.astype(np.float32), context.astype(np.float32)

    def scatter(self, longest: int, rng: np.random.Generator) -> None:
        """Let the rule play until rows are at different moments of their episodes."""
        begin = rng.integers(longest, size=self.env.num_envs)
        for moment in range(longest):
            _, slots, context = self._observe(self._weights)
            self.env.step(self._rule(slots, context))
            if (begin == moment).any():
                self.env.reset(options={"reset_mask": begin == moment})

    def step(self, student: Weights) -> Lesson:
        """Play one decision in every row."""
        actions, slots, context = self._observe(student)
        regret = self._clairvoyant.regrets().astype(np.float32)
        lesson = Lesson(slots, context, np.where(np.isnan(regret), np.float32(np.inf), regret))
        self.env.step(np.where(self._led, self._rule(slots, context), actions))
        return lesson


def padded(lesson: Lesson, capacity: int) -> Lesson:
    """The lesson with ``capacity`` slots: the newcomer and the last two actions stay last."""
    missing = capacity + 1 - lesson.slots.shape[1]
    if not missing:
        return lesson
    at = lesson.slots.shape[1] - 1
    slots = np.insert(lesson.slots, [at] * missing, 0, axis=1)
    return Lesson(slots, lesson.context, np.insert(lesson.regret, [at] * missing, np.inf, axis=1))


def mean_regret(scores: Tensor, regret: Tensor) -> Tensor:
    """The mean of sum_a p(a) regret(a), p being the softmax of the scores of valid actions."""
    valid = torch.isfinite(regret)
    chances = torch.softmax(scores.masked_fill(~valid, -math.inf), dim=1)
    return (chances * regret.masked_fill(~valid, 0)).sum(dim=1).mean()


class HindsightLearner(Learner[Hindsight]):
    """Imitation of the clairvoyant by what each action costs."""

    def cells(self) -> list[Cell]:
        """The links to learn on, each at each L."""
        on, chosen = self.settings.environment, self.settings.suites
        if self.settings.kind == "environment":
            return [Cell("", split_scenario(on)[0], on.capacity)]
        return [c for suite in chosen.suite for c in cells(suite, "train", chosen.capacities_of(suite), chosen.data)]

    def train_seed(self, folder: Any, seed: int, line: int = 0) -> Run:
        """Train one seed; a resumed one has its weights, their mean and its optimizer, and begins to collect anew."""
        torch.set_num_threads(1)
        settings, home = self.settings, folder / f"seed-{seed}"
        home.mkdir(exist_ok=True)
        objective, checkpoint = self.objective(folder, seed), home / "student.pt"
        torch.manual_seed(seed)
        student = Student(settings.width)
        mean = copy.deepcopy(student)
        optimizer = torch.optim.Adam(student.parameters(), settings.learning_rate)
        steps, seconds = 0, 0.0
        if checkpoint.exists():
            saved = torch.load(checkpoint, weights_only=True)
            steps, seconds = saved["steps"], saved["seconds"]
            for part, state in ((student, "student"), (mean, "mean"), (optimizer, "optimizer")):
                part.load_state_dict(saved[state])
        # Every session has a seed of its own, by its first step: the episodes before a kill do not come again.
        rng = np.random.default_rng([seed, steps])
        mixed = self.cells()
        n, L = math.ceil(settings.num_envs / len(mixed)), max(cell.capacity for cell in mixed)
        lessons = Lessons(settings.room, L)
        curve = Record(home / "curve.csv", ("steps", "seconds", "regret"), steps)
        validations = Validations(home, objective.columns, objective.best, settings, steps)
        bar, report, saved_at, spent = seed_bar(settings.steps, steps, seed, line), "", steps, seconds
        began = time.perf_counter()
        groups = [Rows(c, n, mean.weights(), settings.rule_share, int(rng.integers(2**31))) for c in mixed]
        if steps < settings.steps:
            for rows in groups:
                rows.scatter(rows.env.rows.senders.batch.arrivals.shape[1], rng)
        while True:
            ended = steps >= settings.steps or seconds >= self.seconds
            if validations.due(steps, last=ended):
                agent = mean.weights()
                measures = objective.validate(weights.policy_of(objective.name, agent))
                if validations.add(steps, seconds, measures):
                    weights.save(home / MODEL, agent, self.notes(seed, settings.algo))
                report = objective.message.format(*measures)
                bar.set_postfix_str(report, refresh=False)
                if not sys.stderr.isatty():
                    print(f"seed {seed}: {steps:,} of {settings.steps:,} steps, {report}", flush=True)
            if ended or steps - saved_at >= settings.checkpoint_every:
                saved_at = steps
                parts = {"student": student, "mean": mean, "optimizer": optimizer}
                states = {name: part.state_dict() for name, part in parts.items()}
                with replaced(checkpoint) as unfinished:
                    torch.save({"steps": steps, "seconds": seconds, **states}, unfinished)
            if ended:
                break
            playing = mean.weights()
            for rows in groups:
                lessons.add(padded(rows.step(playing), L), rng)
            steps += n * len(groups)
            if lessons.count >= FIRST:
                left = max(LEAST_RATE, 1 - max(steps / settings.steps, seconds / self.seconds))
                for group in optimizer.param_groups:
                    group["lr"] = settings.learning_rate * left
                for _ in range(settings.gradient_steps):
                    slots, context, regret = lessons.draw(settings.batch_size, rng)
                    loss = mean_regret(student(slots, context), regret)
                    optimizer.zero_grad()
                    (REGRET * loss).backward()
                    optimizer.step()
                    with torch.no_grad():
                        for average, latest in zip(mean.parameters(), student.parameters(), strict=True):
                            average.lerp_(latest, 1 - MEAN)
                curve.append(steps, seconds, float(loss.detach()))
            seconds = round(spent + time.perf_counter() - began, 3)
            bar.update(steps - bar.n)
        bar.close()
        return Run(seed, home, seconds, curve.rows, validations.rows, MODEL, objective.best)
