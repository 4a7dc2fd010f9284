"""``gymnasium.vector.VectorEnv`` whose rows are robots: one policy, shared by all of them, learns from every row."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.envs.fleet_rows import FleetRows, check_reward
from bufgym.envs.single import Observation
from bufgym.envs.vector import SenderVectorEnv
from bufgym.errors import BufgymError
from bufgym.scenario import FleetScenario, Uplink


class FleetVecEnv(SenderVectorEnv):
    """``cells`` cells with N ``robots`` each as a batch of cells x N environments: robot r of cell c is row c N + r.

    So any learner for one robot trains weights that all robots of a fleet share, each deciding from its own
    observation:

        from sb3_contrib import MaskablePPO
        from bufgym.sb3 import GymVecEnv

        envs = GymVecEnv(FleetVecEnv(cells=16, robots=4, autoreset_mode="SameStep"))
        MaskablePPO("MultiInputPolicy", envs).learn(1_000_000)

    All is as in ``SenderVectorEnv``, but: the robots of a cell begin and end together; ``reset(seed=s)`` seeds cell c
    with s + c N; ``options["episodes"]`` holds a ``FleetEpisode`` for each cell; ``reward`` is "team" (each robot gets
    the mean over its cell) or "own", of the ``term`` that the other environments call reward. ``reward_terms`` in the
    infos stay each robot's own.
    """

    rows: FleetRows

    def __init__(
        self,
        cells: int = 1,
        robots: int = 4,
        scenario: str | Uplink | FleetScenario = "lte",
        capacity: int = 8,
        *,
        reward: str = "team",
        term: str | Mapping[str, float] = "retained",
        parameters: Mapping[str, Any] | None = None,
        **vector: Any,
    ) -> None:
        if isinstance(cells, bool) or not isinstance(cells, int | np.integer) or cells < 1:
            raise BufgymError(f"cells = {cells!r}: must be a whole number >= 1")
        fleet = FleetScenario.of(robots, scenario, **(parameters or {}))
        limits = {name: vector.get(name) for name in ("max_bytes", "fields")}
        self.reward = check_reward(reward)
        super().__init__(int(cells) * fleet.robots, fleet.uplink, capacity, reward=term, **vector)
        self.rows = FleetRows(int(cells), scenario=fleet, capacity=capacity, term=term, **limits)

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Observation, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        observation, rewards, terminated, truncated, info = super().step(actions)
        return observation, self.rows.shared(rewards, self.reward), terminated, truncated, info
