"""Experts, which say what to do now in any environment: for imitation, DAgger, and the regret of single decisions.

    expert = bufgym.envs.expert.clairvoyant(env)
    expert.actions()  # int64[n]
    expert.values()   # float64[n, L + 2], the best H still attainable after each action

``env`` is an environment of bufgym, single (n = 1) or a native batch, wrapped or not. An expert reads the state that
the environment is in when it is asked.
"""

from bufgym.envs.expert.experts import PolicyExpert, online
from bufgym.envs.expert.hindsight import Clairvoyant
from bufgym.envs.expert.player import Player

clairvoyant = Clairvoyant
"""``clairvoyant(env)`` knows the whole episode: ``actions()`` [n], ``values()`` and ``regrets()`` [n, actions]."""
policy = PolicyExpert
"""``policy(env, "afr")`` makes an expert of a policy: ``actions()`` [n]."""

__all__ = ["Player", "clairvoyant", "online", "policy"]
