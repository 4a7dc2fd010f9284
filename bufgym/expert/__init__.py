"""What an expert would do now, in any environment: for imitation, for DAgger, for the regret of a single decision.

    expert = bufgym.expert.clairvoyant(env)
    expert.actions()  # int64[n]
    expert.values()   # float64[n, L + 2]: the best H that each action still leaves attainable

``env`` is an environment of bufgym, single (n = 1) or a native batch, wrapped or not; an expert reads the state that
the environment is in when it is asked.
"""

from bufgym.expert.experts import PolicyExpert, online, policy
from bufgym.expert.hindsight import Clairvoyant, clairvoyant
from bufgym.expert.player import Player

__all__ = ["Clairvoyant", "Player", "PolicyExpert", "clairvoyant", "online", "policy"]
