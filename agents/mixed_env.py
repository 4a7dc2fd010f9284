"""Training on whole suites: rows of many scenarios (links, motions, V) and capacities side by side.

A learner needs one observation space, but L differs from row to row. So every row is *padded* to as many slots as the
largest L. Slots beyond its own L are always empty, and their eviction is always masked. The newcomer, and the actions
to reject and to accept, stay last. So every batch of experience mixes all cells under one optimizer and one replay.
Padding costs next to nothing, as the slot network does not score empty slots (``bufgym.sb3.SlotScorer``).

Without masks, evicting a padded slot does the same as any invalid action: accept if there is room, else reject.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from bufgym.envs.options import Options
from bufgym.envs.rows import Rows
from bufgym.scenario import Episode, Scenario, suites
from bufgym.utils.errors import BufgymError

Observation = dict[str, NDArray[np.float32]]


class Cell(NamedTuple):
    """One scenario at one capacity.

    ``label`` is the scenario's name in its suite; ``capacity`` is L in messages.
    """

    label: str
    scenario: Scenario
    capacity: int


def cells(suite: str, split: str, capacities: Sequence[int], data: str | None = None) -> list[Cell]:
    """All scenarios of the split at all these capacities."""
    settings = suites.get(suite).settings(split, data)
    return [Cell(label, setting.scenario, L) for label, setting in settings.items() for L in capacities]


class MixedEnv(VectorEnv[Observation, NDArray[np.int64], NDArray[Any]]):
    """``sizes[c]`` rows of each cell c, one cell after the other, as one batch of environments.

    Rows that end begin anew in the same step. After ``reset`` they are at different points of their episodes, so that
    no batch of experience is all beginnings (or all blackouts).

    Args:
        cells: the scenarios and capacities to mix.
        sizes: rows of each cell.
        padded_slots: slots that every row shows; by default the largest L.
        reward: name of the reward term.
        decide_at: "arrival" (every arrival asks for a decision) or "overflow" (a full buffer alone).
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        cells: Sequence[Cell],
        sizes: Sequence[int],
        padded_slots: int = 0,
        reward: str = "retained",
        decide_at: str = "arrival",
        fields: str | None = None,
    ) -> None:
        largest = max(cell.capacity for cell in cells)
        self.padded_slots = padded_slots or largest
        if largest > self.padded_slots:
            raise BufgymError(f"{self.padded_slots} padded slots: a cell has L = {largest}")

        def rows(cell: Cell, size: int) -> Rows:
            options: dict[str, Any] = {"decide_at": decide_at, "reward": reward, "fields": fields}
            return Rows(size, cell.scenario, Options(capacity=cell.capacity, actions="slots", **options))

        self.groups = [rows(cell, size) for cell, size in zip(cells, sizes, strict=True)]
        self.num_envs = sum(sizes)
        ends = np.cumsum(sizes).tolist()
        self.spans = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
        # One row with all the slots: for its spaces, and to name the numbers in the padded arrays.
        self._widest = rows(cells[0]._replace(capacity=self.padded_slots), 1)
        self.single_observation_space = self._widest.observation_space
        self.single_action_space = self._widest.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin new episodes in all rows, each at a random step; ``seed`` has one per row, or row i's is seed + i."""
        if seed is not None:
            seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
            for rows, span in zip(self.groups, self.spans, strict=True):
                for i, row_seed in enumerate(seeds[span]):
                    if row_seed is not None:
                        rows.seed(i, seeding.np_random(row_seed)[0])
            self._np_random = seeding.np_random(seeds[0])[0]
        for rows in self.groups:
            rows.reset(np.arange(len(rows)))
            longest = rows.scenario.max_messages
            entries = self.np_random.integers(longest, size=len(rows))
            accept = np.full(len(rows), rows.capacity + 1)
            for step in range(longest):
                rows.step(accept)
                rows.reset(np.flatnonzero((entries == step) | rows.output.terminated))
        return self.observation(), {}

    def load(self, episodes: Sequence[Episode]) -> None:
        """Begin these episodes, one a row."""
        for rows, span in zip(self.groups, self.spans, strict=True):
            rows.reset(np.arange(len(rows)), episodes[span])

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observation, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Take one decision in every row: observation, rewards, terminated, truncated, info, each with a row an env."""
        self.act(actions)
        rewards = np.concatenate([rows.output.reward_terms @ rows.weights for rows in self.groups])
        ended, info = self.ended(), {}
        observation = self.observation()
        if ended.any():
            final: NDArray[Any] = np.full(self.num_envs, None, object)
            for i in np.flatnonzero(ended):
                final[i] = {name: column[i] for name, column in observation.items()}
            info = {"final_obs": final, "_final_obs": ended}
            for rows, span in zip(self.groups, self.spans, strict=True):
                rows.reset(np.flatnonzero(ended[span]))
            observation = self.observation()
        return observation, rewards, ended, np.zeros(self.num_envs, np.bool_), info

    def act(self, actions: NDArray[np.int64]) -> None:
        """Take one decision in every row; rows that have ended stay as they are."""
        for rows, span in zip(self.groups, self.spans, strict=True):
            action, L = np.asarray(actions[span], np.int64), rows.capacity
            # Beyond L there is nothing to evict; accepting does what a queue does, whether there is room or not.
            unpadded = np.where(action < L, action, L + 1)
            rows.step(np.where(action >= self.padded_slots, action - self.padded_slots + L, unpadded))

    def ended(self) -> NDArray[np.bool_]:
        """bool[n]: whether the row's episode is over."""
        return np.concatenate([rows.output.terminated for rows in self.groups])

    def observation(self) -> Observation:
        """Padded observations of all rows, in fresh arrays."""
        form = self._widest.form
        padded = np.zeros((self.num_envs, form.numbers), np.float32)
        slots, context = form.split(padded)
        for rows, span in zip(self.groups, self.spans, strict=True):
            own_slots, own_context = rows.form.split(rows.output.flat)
            slots[span, :, : rows.capacity] = own_slots[:, :, :-1]
            slots[span, :, -1] = own_slots[:, :, -1]
            context[span] = own_context
        observation: Observation = form.of(padded)
        return observation

    def action_masks(self) -> NDArray[np.bool_]:
        """bool[n, padded slots + 2]: the valid actions of each row."""
        masks = np.zeros((self.num_envs, self.padded_slots + 2), np.bool_)
        for rows, span in zip(self.groups, self.spans, strict=True):
            masks[span, : rows.capacity] = rows.output.action_mask[:, :-2]
            masks[span, -2:] = rows.output.action_mask[:, -2:]
        return masks
