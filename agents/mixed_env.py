"""Training on whole suites: batches of many scenarios (links, motions, V) and capacities side by side.

Ordered candidates look the same for every L, so rows of all cells mix in one batch of experience.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from bufgym.benchmark.sweep import Sweep
from bufgym.envs import SenderVectorEnv
from bufgym.scenario import Scenario


class Cell(NamedTuple):
    """One scenario at one capacity.

    ``label`` is the scenario's name in its suite, ``capacity`` L in messages, ``max_bytes`` B in bytes, or None.
    """

    label: str
    scenario: Scenario
    capacity: int
    max_bytes: int | None = None


def cells(suite: str, split: str, capacities: Sequence[int], data: str | None = None) -> list[Cell]:
    """All scenarios of the split at all these capacities, or at their own where these are the suite's usual ones."""
    chosen = Sweep(suite, (), split, tuple(capacities), 1, data)
    return [
        Cell(label, setting.scenario, L, setting.max_bytes)
        for label, setting in chosen.settings().items()
        for L in chosen.capacities_of(setting)
    ]


class MixedEnv(VectorEnv[NDArray[np.float32], NDArray[np.int64], NDArray[Any]]):
    """``sizes[c]`` rows of each cell c, one cell after the other, as one batch of environments.

    Rows that end begin anew in the same step. After ``reset`` they are at different points of their episodes, so that
    no batch of experience is all beginnings (or all blackouts).

    Args:
        cells: the scenarios and capacities to mix.
        sizes: rows of each cell.
        options: of every environment.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(self, cells: Sequence[Cell], sizes: Sequence[int], **options: Any) -> None:
        self.groups = [
            SenderVectorEnv(
                n, cell.scenario, cell.capacity, max_bytes=cell.max_bytes, autoreset_mode="SameStep", **options
            )
            for cell, n in zip(cells, sizes, strict=True)
        ]
        self.num_envs = sum(sizes)
        ends = np.cumsum(sizes).tolist()
        self._spans = [slice(end - size, end) for end, size in zip(ends, sizes, strict=True)]
        self.single_observation_space = self.groups[0].single_observation_space
        self.single_action_space = self.groups[0].single_action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Begin new episodes in all rows, each at a random step; ``seed`` has one per row, or row i's is seed + i."""
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        observed = []
        for group, span in zip(self.groups, self._spans, strict=True):
            seen: Any = group.reset(seed=None if seeds is None else list(seeds[span]))[0]
            longest, rng = group.sub_envs.scenario.max_messages, group.np_random[0]
            entries = rng.integers(longest, size=group.num_envs)
            for step in range(int(entries.max()) + 1):
                if (entries == step).any():
                    seen, _ = group.reset(options={"reset_mask": entries == step})
                seen = group.step(np.zeros(group.num_envs, np.int64))[0]
            observed.append(seen)
        return np.concatenate(observed), {}

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Take one decision in every row: observation, rewards, terminated, truncated, info, each with a row an env."""
        steps = [group.step(actions[span]) for group, span in zip(self.groups, self._spans, strict=True)]
        seen, rewards, terminated, truncated, infos = zip(*steps, strict=True)
        info: dict[str, Any] = {}
        if any("final_obs" in one for one in infos):
            final: NDArray[Any] = np.full(self.num_envs, None, object)
            for one, span in zip(infos, self._spans, strict=True):
                if "final_obs" in one:
                    final[span] = one["final_obs"]
            info = {"final_obs": final, "_final_obs": np.concatenate(terminated)}
        columns: Any = [np.concatenate(column) for column in (seen, rewards, terminated, truncated)]
        return (*columns, info)
