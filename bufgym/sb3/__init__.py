"""stable-baselines3 and bufgym: the vector environment it accepts, and the slot network as a policy of its own."""

from bufgym.sb3.vec_env import GymVecEnv, make_vec_env

__all__ = ["GymVecEnv", "make_vec_env"]
