"""The clairvoyant as an expert: the value of every action in the state that an environment is in."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.envs.expert.experts import sub_envs_of
from bufgym.envs.fleet_sub_envs import FleetSubEnvs
from bufgym.oracle.hindsight import Hindsight
from bufgym.utils.errors import BufgymError

_TIE = 1e-9  # Values closer than this are equal: they sum the same gaps in another order


class Clairvoyant:
    """Knows the whole link and workload of every episode of one queue.

    Values are exact for equal sizes where every arrival asks; other sizes raise a BufgymError. Under
    ``decide_at="overflow"`` they are upper bounds, as an arrival that asks for no decision counts as one that could be
    rejected.
    """

    def __init__(self, env: Any) -> None:
        self.sub_envs = sub_envs_of(env)
        if isinstance(self.sub_envs, FleetSubEnvs):
            raise BufgymError(
                "expert.clairvoyant: known for one queue with a link of its own, not for robots that share a link"
            )
        self._hindsight = Hindsight(self.sub_envs.senders, "expert.clairvoyant")

    def values(self) -> NDArray[np.float64]:
        """float64[n, actions]: the best H still attainable after each action, in hindsight.

        NaN for invalid actions and missing candidates, and where no decision is due.
        """
        sub_envs, shown = self.sub_envs, self.sub_envs.output.action_mask != 0
        if sub_envs.choices is not None:
            return self._hindsight.values(np.where(shown, sub_envs.output.slot_actions, -1)).copy()
        return np.where(shown, self._hindsight.values(), np.nan)

    def regrets(self) -> NDArray[np.float64]:
        """float64[n, actions]: the part of H that each action gives up for good, 0 for the best; NaN as ``values``."""
        values = self.values()
        most = np.where(np.isnan(values), -np.inf, values).max(axis=1, keepdims=True)
        return np.asarray(most - values)

    def actions(self) -> NDArray[np.int64]:
        """int64[n]: a best action; the idle action where no decision is due.

        Of equal actions accepting comes first, then rejecting, then the oldest slot; among candidates the cheapest.
        """
        values, sub_envs = self.values(), self.sub_envs
        n = values.shape[1]
        order = np.arange(n) if sub_envs.choices is not None else np.array([n - 1, n - 2, *range(n - 2)])
        known = np.where(np.isnan(values), -np.inf, values)[:, order]
        chosen = order[np.argmax(known >= known.max(axis=1, keepdims=True) - _TIE, axis=1)]
        return np.asarray(np.where(np.isnan(values).all(axis=1), sub_envs.idle_action, chosen), np.int64)
