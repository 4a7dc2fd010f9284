"""Environments: a single sender, n of them as one native batch, and robots that share a cell.

``FleetEnv`` and ``parallel_env`` are PettingZoo's and need the extra ``fleet``; the others work without it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from bufgym import oracle  # noqa: F401  (registers the clairvoyant as a policy that can play here)
from bufgym.envs.fleet_vec import FleetVecEnv
from bufgym.envs.single import SenderEnv
from bufgym.envs.vector import SenderVectorEnv
from bufgym.ground.errors import BufgymError, install

if TYPE_CHECKING:
    from bufgym.envs.fleet import FleetEnv, parallel_env

__all__ = ["FleetEnv", "FleetVecEnv", "SenderEnv", "SenderVectorEnv", "parallel_env"]


def __getattr__(name: str) -> Any:
    if name not in ("FleetEnv", "parallel_env"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        from bufgym.envs import fleet
    except ModuleNotFoundError as error:
        if error.name != "pettingzoo":
            raise
        raise BufgymError(f"{name} needs pettingzoo: {install('fleet')}") from None
    return getattr(fleet, name)
