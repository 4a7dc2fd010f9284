"""``gymnasium.vector.VectorEnv`` whose rows are robots: one shared policy learns from every row."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bufgym.envs.fleet_rows import FleetRows
from bufgym.envs.rows import Rows
from bufgym.envs.vector import SenderVectorEnv
from bufgym.model.checks import whole
from bufgym.scenario import FleetScenario, Uplink


class FleetVecEnv(SenderVectorEnv):
    """``cells`` cells with N ``robots`` each, as a batch of cells x N environments. Robot r of cell c is row c N + r.

    Any learner for one robot thus trains weights that all robots of a fleet share, each deciding from its own
    observation:

        from sb3_contrib import MaskablePPO
        from bufgym.sb3 import GymVecEnv

        envs = GymVecEnv(FleetVecEnv(cells=16, robots=4, autoreset_mode="SameStep"))
        MaskablePPO("MultiInputPolicy", envs).learn(1_000_000)

    **Action, observation, episode end** of each row and the other arguments are as in ``SenderVectorEnv``, with these
    differences. The robots of a cell begin and end together. ``reset(seed=s)`` seeds cell c with s + c N.
    ``options["episodes"]`` holds a ``FleetEpisode`` for each cell. ``parameters`` replace the uplink's parameters.

    **Reward** "team" gives each robot the mean over its cell of ``term``, the reward of the other environments; "own"
    gives each robot its own. ``info["reward_terms"]`` has each robot's own terms in any case.
    """

    def __init__(
        self,
        cells: int = 1,
        robots: int = 4,
        scenario: str | Uplink | FleetScenario = "lte",
        capacity: int = 8,
        *,
        parameters: Mapping[str, Any] | None = None,
        **options: Any,
    ) -> None:
        fleet: Any = FleetScenario.of(robots, scenario, **(parameters or {}))
        super().__init__(whole("cells", cells, 1), fleet, capacity, **options)

    def _make_rows(self, n: int, scenario: Any, capacity: int, **options: Any) -> Rows:
        return FleetRows(n, scenario, capacity, **options)
