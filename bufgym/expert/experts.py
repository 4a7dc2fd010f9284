"""Policies as experts: what one of them would do in the state that an environment is in."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import policies
from bufgym.envs.fleet_rows import FleetRows
from bufgym.envs.rows import Rows
from bufgym.errors import BufgymError
from bufgym.expert.player import Player
from bufgym.oracle import law, online_optimum
from bufgym.policies import Policy
from bufgym.scenario import Interruption

_STATE = ("next", "evictions", "now_us", "dequeued", "waiting")
"""Fields of SENDER that tell one decision of an episode from the next."""


def rows_of(env: Any) -> Rows:
    """The rows of an environment of bufgym, below its wrappers and stable-baselines3's adapter."""
    env = getattr(env, "envs", env)
    rows = getattr(getattr(env, "unwrapped", env), "rows", None)
    if not isinstance(rows, Rows):
        raise BufgymError(f"expert: {env!r} is no environment of bufgym, nor a native batch of them")
    return rows


class PolicyExpert:
    """One policy, asked about the decisions of an environment that anybody may play.

    It should be asked at every decision, as its memory holds what it has seen; asked twice about one, it says the same.
    """

    def __init__(self, env: Any, policy: Policy) -> None:
        self.rows = rows_of(env)
        if isinstance(self.rows, FleetRows) and policy.privileged is not None:
            raise BufgymError(f"policy {policy.name}: it plans with a link of its own, which no robot in a cell has")
        n = len(self.rows)
        self._player = Player(policy, n)
        self._asked = np.full((n, 1 + len(_STATE)), -1)
        self._actions = np.zeros(n, np.int64)

    @property
    def policy(self) -> Policy:
        """Whose actions these are."""
        return self._player.policy

    def actions(self) -> NDArray[np.int64]:
        """int64[n]: what the policy does now; L, which has no effect, where no decision is due."""
        senders = self.rows.senders
        state = np.column_stack([senders.begun, *(senders.batch.senders[name] for name in _STATE)])
        new = np.flatnonzero((state != self._asked).any(axis=1))
        if len(new):
            self._actions[new] = self._player.actions(senders, new)[new]
            self._asked[new] = state[new]
        return self._actions.copy()


def policy(env: Any, name: str | Policy) -> PolicyExpert:
    """Any policy as an expert: a registered name, with settings as in ``"decimate:every=2"``, or a ``Policy``."""
    return PolicyExpert(env, policies.get(name))


def online(env: Any, *, objective: str = "ratio", max_states: int = 50_000_000) -> PolicyExpert:
    """The best that does not know T, where that can be computed: ``bufgym/Interruption-v0``, few slots or short T.

    The arguments are those of ``oracle.online_optimum``.
    """
    rows = rows_of(env)
    if not isinstance(rows.scenario, Interruption):
        raise BufgymError(f"expert.online: known for bufgym/Interruption-v0, not for {type(rows.scenario).__name__}")
    best = online_optimum(
        rows.capacity, law(rows.scenario), rows.scenario.value, objective=objective, max_states=max_states
    )
    return PolicyExpert(env, best.policy())
