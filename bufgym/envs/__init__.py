"""Environments: a single sender, n of them as one native batch, and robots that share a cell.

``FleetEnv`` is PettingZoo's and needs the extra ``fleet``; the others work without it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from bufgym import oracle  # noqa: F401  (registers the clairvoyant as a policy that can play here)
from bufgym.envs.fleet_sub_envs import FleetVecEnv
from bufgym.envs.single import SenderEnv
from bufgym.envs.vector import SenderVectorEnv
from bufgym.utils.modules import on_demand

if TYPE_CHECKING:
    from bufgym.envs.fleet import FleetEnv

__all__ = ["FleetEnv", "FleetVecEnv", "SenderEnv", "SenderVectorEnv"]


__getattr__ = on_demand(__name__, {"FleetEnv": "fleet"})
