"""Policies as experts: the action that a policy would choose in an environment's state."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import policies
from bufgym.envs.expert.player import Player
from bufgym.envs.fleet_sub_envs import FleetSubEnvs
from bufgym.envs.sub_envs import SubEnvs
from bufgym.oracle import law, online_optimum
from bufgym.policies import Policy
from bufgym.scenario import Interruption
from bufgym.utils.errors import BufgymError

_STATE = ("next", "evictions", "now_us", "dequeued", "waiting")
"""Fields of SENDER that tell one decision of an episode from the next."""


def sub_envs_of(env: Any) -> SubEnvs:
    """The sub-environments of a bufgym environment, below its wrappers and the adapter of stable-baselines3."""
    env = getattr(env, "envs", env)
    sub_envs = getattr(getattr(env, "unwrapped", env), "sub_envs", None)
    if not isinstance(sub_envs, SubEnvs):
        raise BufgymError(f"expert: {env!r} is no environment of bufgym, nor a native batch of them")
    return sub_envs


class PolicyExpert:
    """One policy, asked about the decisions of an environment that anybody may play.

    ``policy`` is a ``Policy``, or a registered name with settings such as ``"decimate:every=2"``. Ask at every
    decision, so that its memory misses nothing. Asked twice, it gives the same answer.
    """

    def __init__(self, env: Any, policy: str | Policy) -> None:
        self.sub_envs, self.policy = sub_envs_of(env), policies.get(policy)
        if isinstance(self.sub_envs, FleetSubEnvs) and self.policy.privileged is not None:
            raise BufgymError(
                f"policy {self.policy.name}: it plans with a link of its own, which no robot in a cell has"
            )
        n = len(self.sub_envs)
        self._player = Player(self.policy, n)
        self._asked = np.full((n, 1 + len(_STATE)), -1)
        self._actions = np.zeros(n, np.int64)

    def actions(self) -> NDArray[np.int64]:
        """int64[n]: the policy's actions now; the idle action, which has no effect, where no decision is due.

        Where actions are candidates and none of them means what the policy wants, the cheapest candidate goes.
        """
        senders = self.sub_envs.senders
        state = np.column_stack([senders.begun, *(senders.batch.senders[name] for name in _STATE)])
        new = np.flatnonzero((state != self._asked).any(axis=1))
        if len(new):
            self._actions[new] = self._player.actions(senders, new)[new]
            self._asked[new] = state[new]
        return self.sub_envs.of_slots(self._actions).copy()


def online(env: Any) -> PolicyExpert:
    """Make an expert of ``oracle.online_optimum``, which does not know T, for few slots or short interruptions."""
    sub_envs = sub_envs_of(env)
    if not isinstance(sub_envs.scenario, Interruption):
        raise BufgymError(
            f"expert.online: known for bufgym/Interruption-v1, not for {type(sub_envs.scenario).__name__}"
        )
    return PolicyExpert(
        env, online_optimum(sub_envs.capacity, law(sub_envs.scenario), sub_envs.scenario.value).policy()
    )
