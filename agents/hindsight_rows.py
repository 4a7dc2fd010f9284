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
from bufgym.envs.expert.player import Player, as_actions
from bufgym.envs.options import Options
from bufgym.envs.sub_envs import SubEnvs
from bufgym.oracle.hindsight import Hindsight
from bufgym.policies.ruled_network import NOT_OFFERED, seen, watched, watcher

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
        self.groups, self._players, self._teachers = [], [], list[Hindsight]()
        for part in parts:
            options = Options(
                capacity=part.cell.capacity,
                max_bytes=part.cell.max_bytes,
                decide_at="arrival",
                actions="slots",
                fields=("occupancy",),
                reward="retained",  # nobody reads it, and the default plays a shadow beside each row
                info="mask",
            )
            sub_envs = SubEnvs(part.rows, part.cell.scenario, options)
            self.groups.append(sub_envs)
            self._players.append(Player(watcher(candidates), part.rows))
            self._teachers.append(Hindsight(sub_envs.senders, "train.py hindsight"))
        self._ruled = np.concatenate([np.arange(size) < max(size // RULED, size > 1) for size in sizes])
        self._candidates = candidates
        self.seen = np.zeros((self.n, seen(candidates)), np.float32)
        self.decisions = np.zeros((self.n, candidates + 3), np.int64)
        """int64[n, actions]: the slot action that each action stands for, ``NOT_OFFERED`` where it is not offered."""
        for sub_envs in self.groups:
            for i in range(len(sub_envs)):
                sub_envs.seed(i, seeding.np_random(int(rng.integers(2**31)))[0])
            sub_envs.reset(np.arange(len(sub_envs)))
        self._observe()

    @property
    def offered(self) -> NDArray[np.bool_]:
        """bool[n, actions]: whether each action is offered."""
        return np.asarray(self.decisions != NOT_OFFERED)

    def _observe(self) -> None:
        actions, numbers, k = self.decisions.shape[1], self.seen.shape[1], self._candidates
        for sub_envs, span, player in zip(self.groups, self.spans, self._players, strict=True):
            player.actions(sub_envs.senders)
            decisions, seen_numbers = watched(player.memory, k)
            self.seen[span], answers = seen_numbers[:, :numbers], decisions[:, :actions].astype(np.int64)
            self.decisions[span] = np.where(answers == NOT_OFFERED, NOT_OFFERED, as_actions(answers, sub_envs.capacity))

    def _act(self, decisions: NDArray[np.int64]) -> None:
        for sub_envs, span in zip(self.groups, self.spans, strict=True):
            sub_envs.step(decisions[span])
            if sub_envs.output.terminated.any():
                sub_envs.reset(np.flatnonzero(sub_envs.output.terminated))
        self._observe()

    def _by_rule(self) -> NDArray[np.int64]:
        """int64[n]: action 0, or what the rule gap-price does where it alone is offered."""
        return np.where(self.decisions[:, 0] == NOT_OFFERED, self.decisions[:, -1], self.decisions[:, 0])

    def scatter(self, rng: np.random.Generator) -> None:
        """Let the rule play until rows are at different moments of their episodes."""
        longest = [min(sub_envs.scenario.max_messages, LONGEST) for sub_envs in self.groups]
        begin = [rng.integers(steps, size=len(sub_envs)) for sub_envs, steps in zip(self.groups, longest, strict=True)]
        for moment in range(max(longest)):
            decisions = self._by_rule()
            for sub_envs, span, at in zip(self.groups, self.spans, begin, strict=True):
                sub_envs.step(decisions[span])
                again = sub_envs.output.terminated | (at == moment)
                if again.any():
                    sub_envs.reset(np.flatnonzero(again))
            self._observe()

    def step(self, choose: Choose) -> Lesson:
        """Play one decision in every row, and say what each action would have cost."""
        cost, offered = np.empty(self.decisions.shape), self.offered
        for span, teacher in zip(self.spans, self._teachers, strict=True):
            values = teacher.values(np.where(offered[span], self.decisions[span], -1))
            best = np.where(np.isnan(values), -np.inf, values).max(axis=1, keepdims=True)
            cost[span] = np.where(np.isnan(values), np.inf, best - values)
        lesson = Lesson(self.seen.copy(), cost.astype(np.float32))
        chosen = np.take_along_axis(self.decisions, choose(self.seen, offered)[:, None], axis=1)[:, 0]
        self._act(np.where(self._ruled, self._by_rule(), chosen))
        return lesson


class Lessons:
    """All lessons of each family so far, up to ``room``; then new ones take the places of others at random.

    ``shape`` is (numbers seen, actions).
    """

    def __init__(self, families: int, room: int, shape: tuple[int, int]) -> None:
        self.room, self.counts = room, np.zeros(families, np.int64)
        self._seen, self._cost = (torch.zeros(families * room, size) for size in shape)
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
        seen, cost = self._seen[places], self._cost[places]
        known = (cost / units[:, None]).clamp(max=MOST)
        return seen, torch.where(torch.isfinite(cost), known, cost)
