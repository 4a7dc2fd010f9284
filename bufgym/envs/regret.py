"""The reward ``regret``: how much of the best attainable H each decision gives up.

Let V* be the best H that can still be reached from a state by somebody who knows the whole link and workload. The
reward of a step is the change of V*, and at the end H takes its place. V*(start) is the clairvoyant's H of the episode;
what is lost before the first decision counts in the first step. So the rewards of an episode sum to H - V*(start), and
the best policy is the same as under ``retained``: this is reward shaping by a potential [ng1999policy]. The luck of
link and motion is taken out of the reward. Only the reward sees the future: observations and evaluations do not.
"""

import numpy as np
from numpy.typing import NDArray

from bufgym.envs.output import StepOutput
from bufgym.oracle.hindsight import Hindsight
from bufgym.sim import Senders


class Regret:
    """The term's numbers for all rows of an environment, in column ``column`` of ``StepOutput.reward_terms``."""

    def __init__(self, senders: Senders, column: int) -> None:
        self._hindsight, self._column = Hindsight(senders, "reward = 'regret'"), column
        self._most = np.zeros(len(senders))
        self._every = np.arange(len(senders))

    def begin(self, rows: NDArray[np.int64]) -> None:
        """Note V* of the episodes that these ``rows`` have loaded and not begun to play."""
        self._most[rows] = self._hindsight.at_start(rows)[rows]

    def write(self, output: StepOutput) -> None:
        """Write the change of V* in the step that all rows have just taken."""
        now = np.where(output.terminated, output.qoi, self._hindsight.most(self._every))
        output.reward_terms[:, self._column] = now - self._most
        self._most = now
