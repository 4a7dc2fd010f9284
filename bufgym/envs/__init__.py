"""The Gymnasium environments; importing ``bufgym`` registers them."""

from bufgym.envs.single import SenderEnv
from bufgym.envs.vector import SenderVectorEnv

__all__ = ["SenderEnv", "SenderVectorEnv"]
