"""Many robots in one cell: what there is for them, in one place.

``FleetEnv`` and ``parallel_env`` are PettingZoo's and need the extra ``fleet``; all the rest does without it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from bufgym.envs.fleet_vec import FleetVecEnv
from bufgym.errors import BufgymError
from bufgym.scenario import FleetEpisode, FleetScenario
from bufgym.sim.cell import Fleet, run_fleet

if TYPE_CHECKING:
    from bufgym.envs.fleet import FleetEnv, parallel_env

__all__ = [
    "Fleet",
    "FleetEnv",
    "FleetEpisode",
    "FleetScenario",
    "FleetVecEnv",
    "parallel_env",
    "run_fleet",
]


def __getattr__(name: str) -> Any:
    if name not in ("FleetEnv", "parallel_env"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        from bufgym.envs import fleet
    except ModuleNotFoundError as error:
        if error.name != "pettingzoo":
            raise
        raise BufgymError(f'{name} needs pettingzoo: pip install "bufgym[fleet]"') from None
    return getattr(fleet, name)
