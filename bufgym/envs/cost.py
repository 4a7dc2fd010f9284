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

from collections.abc import Callable, Sequence
from typing import Any

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


@kernel
def write_cost(
    batch: Batch,
    rows: NDArray[np.int64],
    robots: int,
    begins: bool,
    past: NDArray[np.float64],
    column: int,
    output: StepOutput,
) -> None:
    """Write ``cost`` of the step that each of ``rows``, cells of so many ``robots``, has just taken.

    ``past``, float64[n, 3], has what each row stood at, its V(steps), and the arrivals that these are of.
    """
    for c in rows:
        for i in range(c * robots, (c + 1) * robots):
            if begins:
                past[i, :] = 0.0
                output.reward_terms[i, column] = 0.0
                continue
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
def write_paired(
    batch: Batch,
    rows: NDArray[np.int64],
    begins: bool,
    past: NDArray[np.float64],
    column: int,
    output: StepOutput,
    shadows: Batch,
    memory: NDArray[np.float64],
    on_arrival: Any,
    on_departure: Any,
    on_dequeue: Any,
    on_send: Any,
    hears_departures: bool,
) -> None:
    """Write ``paired`` likewise; ``past``, float64[n], has what each row stood above its shadow."""
    for i in rows:
        if begins:
            past[i] = output.reward_terms[i, column] = 0.0
            continue
        ended = output.terminated[i]
        arrival = batch.senders[i].arrivals if ended else batch.senders[i].next
        catch_up(shadows, i, arrival, memory, on_arrival, on_departure, on_dequeue, on_send, hears_departures)
        if ended:
            settle_gains(shadows, i, True)
        stands = standing(batch, i, ended) - standing(shadows, i, ended)
        output.reward_terms[i, column] = stands - past[i]
        past[i] = stands
        add_rewards(output, i)


class Charges:
    """The terms of this module that an environment names, written for all of its rows after each step."""

    def __init__(self, senders: Senders, names: Sequence[str], reference: str | Policy, robots: int = 1) -> None:
        """``names`` are those of all terms, by column. ``robots`` share a link each; none has a shadow then."""
        n, self._senders, self._robots = len(senders), senders, robots
        self._cost, self._paired = (names.index(name) if name in names else -1 for name in CHARGED)
        self._of_cost, self._above = np.zeros((n, 3)), np.zeros(n)
        self.shadows = Shadows(senders, reference, "reward = 'paired'") if self._paired >= 0 else None

    def begin(self, rows: NDArray[np.int64]) -> None:
        """Begin the episodes that these rows have just loaded."""
        if self.shadows is not None:
            self.shadows.begin(rows)

    def write(self, call: Callable[..., None], rows: NDArray[np.int64], begins: bool, output: StepOutput) -> None:
        """Write the terms of ``rows``, or of cells, which have begun an episode or taken a step."""
        batch = self._senders.batch
        if self._cost >= 0:
            call(write_cost, batch, rows, self._robots, begins, self._of_cost, self._cost, output)
        if self.shadows is not None:
            policy, shadows = self.shadows.policy, self.shadows.batch
            call(
                write_paired, batch, rows, begins, self._above, self._paired, output, shadows, self.shadows.memory,
                *policy.compiled, policy.hears_departures,
            )  # fmt: skip
