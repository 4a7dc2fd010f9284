"""What ``agents.hindsight`` learns from: states that the student reaches, and the cost of each action there."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from gymnasium.utils import seeding
from numpy.typing import NDArray
from torch import Tensor

from agents.mixed_env import Cell
from bufgym.envs.options import Options
from bufgym.envs.rows import Rows
from bufgym.oracle.hindsight import Hindsight
from bufgym.policies.candidate_network import inputs

Choose = Callable[[NDArray[np.float32], NDArray[np.bool_]], NDArray[np.int64]]
"""(observations [n, inputs], offered actions [n, actions]) -> actions [n]."""
RULED = 6
"""The rule, action 0, plays one row in so many: good states never end, and a student that fell finds its way back."""
LONGEST = 600
"""Most steps over which rows are spread at first."""
MOST = 60.0
"""Largest cost, in units of the mean cost of action 0."""


class Part(NamedTuple):
    """Rows of one family of links, all of one scenario at one L."""

    family: str
    cell: Cell
    rows: int


class Lesson(NamedTuple):
    """What n rows show, and what each action costs."""

    seen: NDArray[np.float32]
    """float32[n, inputs]"""
    cost: NDArray[np.float32]
    """float32[n, actions], H given up for good by each action; infinite for those that are not offered."""


class TaughtRows:
    """Environments of several cells side by side, with the clairvoyant's word on every decision.

    Args:
        parts: the rows of each cell.
        candidates: k, of every row.
        rng: for episodes.
    """

    def __init__(self, parts: Sequence[Part], candidates: int, rng: np.random.Generator) -> None:
        self.families = list(dict.fromkeys(part.family for part in parts))
        sizes = [part.rows for part in parts]
        self.n, ends = sum(sizes), np.cumsum(sizes).tolist()
        self.spans = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
        self.family = np.repeat([self.families.index(part.family) for part in parts], sizes)
        """int64[n]: number of each row's family."""
        self.groups = []
        for part in parts:
            options = Options(capacity=part.cell.capacity, decide_at="arrival", candidates=candidates, info="none")
            self.groups.append(Rows(part.rows, part.cell.scenario, options))
        self._teachers = [Hindsight(rows.senders, "train.py hindsight") for rows in self.groups]
        self._ruled = np.concatenate([np.arange(size) < max(size // RULED, size > 1) for size in sizes])
        self.seen = np.zeros((self.n, inputs(candidates)), np.float32)
        self.offered = np.zeros((self.n, candidates + 2), np.bool_)
        for rows in self.groups:
            for i in range(len(rows)):
                rows.seed(i, seeding.np_random(int(rng.integers(2**31)))[0])
            rows.reset(np.arange(len(rows)))
        self._observe()

    def _observe(self) -> None:
        for rows, span in zip(self.groups, self.spans, strict=True):
            self.seen[span], self.offered[span] = rows.output.flat, rows.output.action_mask

    def _act(self, actions: NDArray[np.int64]) -> None:
        for rows, span in zip(self.groups, self.spans, strict=True):
            rows.step(actions[span])
            if rows.output.terminated.any():
                rows.reset(np.flatnonzero(rows.output.terminated))
        self._observe()

    def scatter(self, rng: np.random.Generator) -> None:
        """Let the rule play until rows are at different moments of their episodes."""
        longest = [min(rows.scenario.max_messages, LONGEST) for rows in self.groups]
        begin = [rng.integers(steps, size=len(rows)) for rows, steps in zip(self.groups, longest, strict=True)]
        for moment in range(max(longest)):
            for rows, at in zip(self.groups, begin, strict=True):
                rows.step(np.zeros(len(rows), np.int64))
                again = rows.output.terminated | (at == moment)
                if again.any():
                    rows.reset(np.flatnonzero(again))
        self._observe()

    def step(self, choose: Choose) -> Lesson:
        """Play one decision in every row, and say what each action would have cost."""
        cost = np.empty(self.offered.shape)
        for rows, span, teacher in zip(self.groups, self.spans, self._teachers, strict=True):
            decisions = np.where(rows.output.action_mask != 0, rows.output.slot_actions, -1)
            cost[span] = teacher.values(decisions)
        best = np.where(np.isnan(cost), -np.inf, cost).max(axis=1, keepdims=True)
        lesson = Lesson(self.seen.copy(), np.where(np.isnan(cost), np.inf, best - cost).astype(np.float32))
        actions = choose(self.seen, self.offered)
        actions[self._ruled] = 0
        self._act(actions)
        return lesson


class Lessons:
    """All lessons of each family so far, up to ``room``; then new ones take the places of others at random."""

    def __init__(self, families: int, room: int, candidates: int) -> None:
        self.room, self.counts = room, np.zeros(families, np.int64)
        self._seen = torch.zeros(families * room, inputs(candidates))
        self._cost = torch.zeros(families * room, candidates + 2)
        self._of_rule, self._met = np.zeros(families), np.zeros(families)

    def add(self, lesson: Lesson, family: NDArray[np.int64], rng: np.random.Generator) -> None:
        """Keep these, with the number of each row's family, where action 0 and another one are offered."""
        is_choice = np.isfinite(lesson.cost[:, 0]) & (np.isfinite(lesson.cost).sum(axis=1) > 1)
        for f in range(len(self.counts)):
            rows = np.flatnonzero(is_choice & (family == f))
            n, count = len(rows), int(self.counts[f])
            places = np.arange(count, count + n) if count + n <= self.room else rng.integers(self.room, size=n)
            self.counts[f] = min(count + n, self.room)
            to = torch.from_numpy(places + f * self.room)
            self._seen[to], self._cost[to] = torch.from_numpy(lesson.seen[rows]), torch.from_numpy(lesson.cost[rows])
            self._of_rule[f] += lesson.cost[rows, 0].sum(dtype=np.float64)
            self._met[f] += n

    @property
    def units(self) -> NDArray[np.float64]:
        """float64[families]: the mean cost of action 0, in which a family's costs are counted."""
        return self._of_rule / np.maximum(self._met, 1) + 1e-12

    def draw(self, sizes: NDArray[np.int64], rng: np.random.Generator) -> tuple[Tensor, Tensor]:
        """So many of each family at random: what was seen, and costs in units of the family's own."""
        family = np.repeat(np.arange(len(sizes)), sizes)
        places = torch.from_numpy((rng.random(len(family)) * self.counts[family]).astype(np.int64) + family * self.room)
        units = torch.from_numpy(self.units[family].astype(np.float32))
        cost = self._cost[places] / units[:, None]
        return self._seen[places], torch.where(torch.isfinite(cost), cost.clamp(max=MOST), cost)
