"""Training on a whole suite: rows of many scenarios (links, motions, V) and capacities side by side.

A learner wants one observation space, and L differs from row to row. So every row is shown as if it had as many slots
as the largest L (its *seats*): the seats beyond its own L are always empty, and their eviction is always masked. The
newcomer, and the actions to reject and to accept, stay last. Thus every batch of experience mixes all cells, with one
optimizer and one replay, which going round the capacities in chunks would not; and seats cost next to nothing, as the
slot network does not score empty slots (``network.SlotScorer``).

Without masks, evicting a seat beyond L does what any impossible action does: accept where there is room, else reject.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from bufgym.envs.rows import Rows
from bufgym.errors import BufgymError
from bufgym.observe import CONTEXT_FIELDS, SLOT_FIELDS
from bufgym.scenario import Episode, Scenario, suites

Observation = dict[str, NDArray[np.float32]]


class Cell(NamedTuple):
    """One scenario at one capacity."""

    label: str
    scenario: Scenario
    capacity: int


def capacities_of(suite: str, given: str) -> tuple[int, ...]:
    """L to train for and to test at: those given ("5,10,25"), or the suite's."""
    if not given:
        return suites.get(suite).capacities
    try:
        chosen = tuple(int(part) for part in given.split(","))
    except ValueError:
        raise BufgymError(f"capacities = {given!r}: must be whole numbers such as 5,10,25") from None
    if min(chosen) < 1 or len(set(chosen)) < len(chosen):
        raise BufgymError(f"capacities = {given!r}: must be whole numbers >= 1, no two alike")
    return chosen


def cells(suite: str, split: str, capacities: Sequence[int], data: str | None = None) -> list[Cell]:
    """All scenarios of the split at all these capacities."""
    settings = suites.get(suite).settings(split, data)
    return [Cell(label, setting.scenario, L) for label, setting in settings.items() for L in capacities]


class World(VectorEnv[Observation, NDArray[np.int64], NDArray[Any]]):
    """``sizes[c]`` rows of each cell c, one cell after the other, as one batch of environments.

    Every arrival asks for a decision. Rows that end begin anew in the same step. After ``reset`` they are at different
    points of their episodes, so that no batch of experience is all beginnings (or all blackouts).
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, cells: Sequence[Cell], sizes: Sequence[int], seats: int = 0, reward: str = "retained") -> None:
        self.seats = seats or max(cell.capacity for cell in cells)
        if any(cell.capacity > self.seats for cell in cells):
            raise BufgymError(f"{self.seats} seats: a cell has L = {max(cell.capacity for cell in cells)}")
        self.groups = [_rows(cell, size, reward) for cell, size in zip(cells, sizes, strict=True)]
        self.num_envs = sum(sizes)
        ends = np.cumsum(sizes).tolist()
        self.spans = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
        # One row with as many slots as seats: for its spaces, and to name the numbers in the padded arrays.
        self._widest = _rows(cells[0]._replace(capacity=self.seats), 1, reward)
        self.single_observation_space = self._widest.observation_space
        self.single_action_space = self._widest.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        if seed is not None:
            seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
            for rows, span in zip(self.groups, self.spans, strict=True):
                for i, given in enumerate(seeds[span]):
                    if given is not None:
                        rows.seed(i, seeding.np_random(given)[0])
            self._np_random = seeding.np_random(seeds[0])[0]
        for rows in self.groups:
            rows.reset(np.arange(len(rows)))
            longest = rows.scenario.max_messages
            begins = self.np_random.integers(longest, size=len(rows))
            accept = np.full(len(rows), rows.capacity + 1)
            for step in range(longest):
                rows.step(accept)
                rows.reset(np.flatnonzero((begins == step) | rows.output.terminated))
        return self.observation(), {}

    def load(self, episodes: Sequence[Episode]) -> None:
        """Begin these episodes, one a row."""
        for rows, span in zip(self.groups, self.spans, strict=True):
            rows.reset(np.arange(len(rows)), episodes[span])

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observation, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        self.act(actions)
        rewards = np.concatenate([rows.output.reward_terms @ rows.weights for rows in self.groups])
        ended, info = self.ended(), {}
        seen = self.observation()
        if ended.any():
            final: NDArray[Any] = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(ended):
                final[i] = {name: column[i] for name, column in seen.items()}
            info = {"final_obs": final, "_final_obs": ended}
            for rows, span in zip(self.groups, self.spans, strict=True):
                rows.reset(np.flatnonzero(ended[span]))
            seen = self.observation()
        return seen, rewards, ended, np.zeros(self.num_envs, np.bool_), info

    def act(self, actions: NDArray[np.int64]) -> None:
        """One decision in every row; rows that have ended stay as they are."""
        for rows, span in zip(self.groups, self.spans, strict=True):
            given, L = np.asarray(actions[span], np.int64), rows.capacity
            # Beyond L there is nothing to evict; accepting does what a queue does, whether there is room or not.
            rows.step(np.where(given >= self.seats, given - self.seats + L, np.where(given < L, given, L + 1)))

    def ended(self) -> NDArray[np.bool_]:
        """bool[n]: the row's episode is over."""
        return np.concatenate([rows.output.terminated for rows in self.groups])

    def observation(self) -> Observation:
        """Every row's, with its slots spread over the seats; fresh arrays."""
        slots = np.zeros((self.num_envs, len(SLOT_FIELDS), self.seats + 1), np.float32)
        context = np.empty((self.num_envs, len(CONTEXT_FIELDS)), np.float32)
        for rows, span in zip(self.groups, self.spans, strict=True):
            slots[span, :, : rows.capacity] = rows.output.slots[:, :, :-1]
            slots[span, :, -1] = rows.output.slots[:, :, -1]
            context[span] = rows.output.context
        return self._widest.observation(slots, context)

    def action_masks(self) -> NDArray[np.bool_]:
        """bool[n, seats + 2]: the actions that are possible now in each row."""
        masks = np.zeros((self.num_envs, self.seats + 2), np.bool_)
        for rows, span in zip(self.groups, self.spans, strict=True):
            masks[span, : rows.capacity] = rows.output.action_mask[:, :-2]
            masks[span, -2:] = rows.output.action_mask[:, -2:]
        return masks


def _rows(cell: Cell, size: int, reward: str) -> Rows:
    return Rows(size, cell.scenario, cell.capacity, reward=reward)
