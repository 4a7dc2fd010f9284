"""Experts, which say what to do now in any environment: for imitation, DAgger, and the regret of single decisions.

    expert = bufgym.envs.expert.clairvoyant(env)
    expert.actions()  # int64[n]
    expert.values()   # float64[n, L + 2], the best H still attainable after each action

``env`` is an environment of bufgym, single (n = 1) or a native batch, wrapped or not. An expert reads the state that
the environment is in when it is asked.
"""

from bufgym.envs.expert import dataset
from bufgym.envs.expert.experts import PolicyExpert, online
from bufgym.envs.expert.hindsight import Clairvoyant
from bufgym.envs.expert.player import Player

clairvoyant, policy = Clairvoyant, PolicyExpert
"""The expert that knows the whole episode, and any policy as one, named like the others."""

__all__ = ["Clairvoyant", "Player", "PolicyExpert", "clairvoyant", "dataset", "online", "policy"]
