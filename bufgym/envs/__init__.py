"""Environments: a single sender, n of them as one native batch, and robots that share a cell.

``FleetEnv`` and ``parallel_env`` are PettingZoo's and need the extra ``fleet``; the others work without it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from bufgym import oracle  # noqa: F401  (registers the clairvoyant as a policy that can play here)
from bufgym.envs.fleet_sub_envs import FleetVecEnv
from bufgym.envs.single import SenderEnv
from bufgym.envs.vector import SenderVectorEnv
from bufgym.utils.modules import on_demand

if TYPE_CHECKING:
    from bufgym.envs.fleet import FleetEnv, parallel_env
    from bufgym.envs.observation import ObservationForm

__all__ = ["FleetEnv", "FleetVecEnv", "ObservationForm", "SenderEnv", "SenderVectorEnv", "parallel_env"]


__getattr__ = on_demand(__name__, {"FleetEnv": "fleet", "parallel_env": "fleet", "ObservationForm": "observation"})
