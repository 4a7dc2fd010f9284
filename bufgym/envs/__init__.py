"""Gymnasium environments: a single sender, and n of them as one native batch."""

from bufgym import oracle  # noqa: F401  (registers the clairvoyant, so that it can play here)
from bufgym.envs.single import SenderEnv
from bufgym.envs.vector import SenderVectorEnv

__all__ = ["SenderEnv", "SenderVectorEnv"]
