"""The rewards ``cost`` and ``paired``: what decisions cost, without what arrivals bring whatever one does.

``retained`` rises with every arrival that is kept and cannot say what a rejected newcomer costs before the next one is
kept. ``cost`` adds T and takes off V(steps). T is V of the motion from the last message kept to the newest arrival, so
a gap is charged as it grows. V(steps) is the sum of V over the motion from each arrival to the next, what the episode
would bring if nothing were ever dropped. What is left is the loss by merged gaps. At the end T is 0, as no message
closes that gap. So the rewards of an episode sum to H - 1 less a constant of the episode, and the best policy is that
of ``retained``. All of it is known on board.

``paired`` is ``cost`` less the ``cost`` that a rule has had by the same arrival of the same episode
(``bufgym.sim.shadow``). Both have seen the same arrivals, so V(steps) cancels, and much of the link's luck with it. The
rewards of an episode sum to its H less that rule's H.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.envs.output import StepOutput, add_rewards, settle_gains
from bufgym.jit import kernel, unchecked_at
from bufgym.model.qoi import value
from bufgym.policies import Policy
from bufgym.sim import Senders
from bufgym.sim.rules import gain_behind
from bufgym.sim.shadow import Shadows, catch_up
from bufgym.sim.state import Batch

CHARGED = ("cost", "paired")
"""The terms of this module, in the order of their columns."""


@kernel
def standing(batch: Batch, i: int, ended: bool) -> float:
    """What row ``i`` has retained, and V of the gap behind the last message kept, which grows with each arrival."""
    sender = batch.senders[i]
    if ended:
        return float(sender.retained_gain)
    return float(sender.retained_gain + gain_behind(batch, i, sender.occupancy, 0, sender.previous_x))


class Charged(NamedTuple):
    """The term ``cost`` of n rows.

    Fields:
        past: float64[n, 3], what each row stood at, its V(steps), and the arrivals that these are of.
        column: of the term.
    """

    past: NDArray[np.float64]
    column: int


class Rival(NamedTuple):
    """The term ``paired`` of n rows, and the shadows it is paired with.

    Fields:
        above: float64[n], what each row stood at above its shadow.
        column: of the term.
        shadows, memory: the arrays of ``Shadows``; the other fields are the rule's functions.
    """

    above: NDArray[np.float64]
    column: int
    shadows: Batch
    memory: NDArray[np.float64]
    on_arrival: Any
    on_departure: Any
    on_dequeue: Any
    on_send: Any
    hears_departures: bool


@kernel
def write_cost(batch: Batch, i: int, begins: bool, charged: Charged, output: StepOutput) -> None:
    """Write ``cost`` of the step that row ``i`` has just taken; a row that ``begins`` has cost nothing."""
    past, column = charged.past, charged.column
    if begins:
        past[i, :] = 0.0
        output.reward_terms[i, column] = 0.0
        return
    sender = batch.senders[i]
    for k in range(max(int(past[i, 2]), 1), sender.next):
        step = unchecked_at(batch.arrivals, i, k).x - unchecked_at(batch.arrivals, i, k - 1).x
        past[i, 1] += value(batch.v[sender.v_start :], step)
    past[i, 2] = sender.next
    stands = standing(batch, i, output.terminated[i]) - past[i, 1]
    output.reward_terms[i, column] = stands - past[i, 0]
    past[i, 0] = stands
    add_rewards(output, i)


@kernel
def write_paired(batch: Batch, i: int, begins: bool, rival: Rival, output: StepOutput) -> None:
    """Write ``paired`` likewise; the row's shadow follows."""
    above, column, shadows = rival.above, rival.column, rival.shadows
    if begins:
        above[i] = output.reward_terms[i, column] = 0.0
        return
    ended = output.terminated[i]
    arrival = batch.senders[i].arrivals if ended else batch.senders[i].next
    catch_up(
        shadows, i, arrival, rival.memory, rival.on_arrival, rival.on_departure, rival.on_dequeue, rival.on_send,
        rival.hears_departures,
    )  # fmt: skip
    if ended:
        settle_gains(shadows, i, True)
    stands = standing(batch, i, ended) - standing(shadows, i, ended)
    output.reward_terms[i, column] = stands - above[i]
    above[i] = stands
    add_rewards(output, i)


class Charges:
    """The terms of this module that an environment names: ``cost`` and ``rival`` for the kernels, or None."""

    def __init__(self, senders: Senders, names: Sequence[str], reference: str | Policy) -> None:
        """``names`` are those of all terms, by column."""
        n = len(senders)
        self.cost = Charged(np.zeros((n, 3)), names.index("cost")) if "cost" in names else None
        self.rival, self._shadows = None, None
        if "paired" in names:
            self._shadows = Shadows(senders, reference, "reward = 'paired'")
            policy, batch = self._shadows.policy, self._shadows.batch
            functions = (*policy.compiled, policy.hears_departures)
            self.rival = Rival(np.zeros(n), names.index("paired"), batch, self._shadows.memory, *functions)

    def begin(self, rows: NDArray[np.int64]) -> None:
        """Begin the episodes that these rows have just loaded."""
        if self._shadows is not None and self.rival is not None:
            self._shadows.begin(rows)
            if self.rival.shadows is not self._shadows.batch:
                self.rival = self.rival._replace(shadows=self._shadows.batch)
