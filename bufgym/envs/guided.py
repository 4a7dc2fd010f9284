"""Guided environments: an action sets the numbers of the rule gap-price, and an observation holds what the rule knows.

``actions="guided"`` and ``fields="guided"`` may be used together or alone. Each row has the rule's memory
(``bufgym.policies.guided``), which learns of every decision.
"""

from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from bufgym.envs.options import GUIDED, InvalidActionError, Options
from bufgym.envs.output import StepOutput, decision_of, write_observation, write_state
from bufgym.jit import kernel, unchecked_slice
from bufgym.model.observe import Chosen
from bufgym.policies.guided import BASE, N_INPUTS, N_OUTPUTS, OUTPUTS, SCALES, GuidedWeights, follow, inputs, recall
from bufgym.sim.state import Batch
from bufgym.sim.view import arrival_of, view


class Guide(NamedTuple):
    """What n rows need for guided steps; the kernel writes the memory in place.

    Fields:
        memory: float64[n, entries], the rule's memory.
        base: float64[numbers], the plain rule's.
        outputs: float64[n, outputs], what the present actions add to them.
        acts: 1 if actions are guided.
        sees: 1 if the observation holds the rule's inputs alone.
    """

    memory: NDArray[np.float64]
    base: NDArray[np.float64]
    outputs: NDArray[np.float64]
    acts: int
    sees: int


@kernel
def guided_decision(batch: Batch, i: int, action: int, guide: Guide) -> int:
    """The decision of the rule with the numbers of ``guide.outputs``, or of ``action`` if actions are not guided."""
    if guide.acts == 0:
        return decision_of(action, batch.senders[i].capacity)
    return follow(view(batch, i), arrival_of(batch, i), guide.memory[i], guide.base, guide.outputs[i])


@kernel
def write_guided(batch: Batch, i: int, ended: bool, output: StepOutput, guide: Guide, chosen: Chosen | None) -> None:
    """Let the rule learn of what happened, and write row ``i``'s state and observation, the rule's inputs if seen."""
    if guide.sees == 0:
        write_observation(batch, i, ended, output, chosen)
    else:
        write_state(batch, i, ended, output)
    if ended:
        return
    buffer, arrival = view(batch, i), arrival_of(batch, i)
    recall(buffer, arrival, guide.memory[i], guide.base)
    if guide.sees == 1:
        inputs(buffer, arrival, guide.memory[i], guide.base, unchecked_slice(output.flat, i, 0, N_INPUTS))


class Guiding:
    """The guided part of n rows."""

    def __init__(self, n: int, options: Options) -> None:
        plain = GuidedWeights(np.zeros((N_OUTPUTS, N_INPUTS), np.float32)).policy(GUIDED)
        memory = plain.new_memory(n, options.capacity)
        self.guide = Guide(memory, BASE, np.zeros((n, N_OUTPUTS)), int(options.acts_guided), int(options.sees_guided))
        self._nothing = np.zeros(n, np.int64)
        self.action_space = spaces.Box(-1.0, 1.0, (N_OUTPUTS,), np.float32)

    def begin(self, rows: NDArray[np.int64]) -> None:
        """Forget all in ``rows``, where episodes begin."""
        self.guide.memory[rows] = 0.0

    def take(self, name: str, actions: Any) -> NDArray[np.int64]:
        """Keep the actions, float[outputs] of the one row or float[n, outputs], for the next step.

        Returns what the kernels take for actions.
        """
        outputs, numbers = self.guide.outputs, np.asarray(actions)
        shape = outputs.shape if name == "actions" else outputs.shape[1:]
        if numbers.dtype.kind not in "iuf" or numbers.shape != shape:
            known = ", ".join(output.name for output in OUTPUTS)
            shown = f"{numbers.dtype}{list(numbers.shape)}"
            raise InvalidActionError(f"{name} is {shown}: must be float{list(shape)}: {known}")
        if not (np.abs(numbers) <= 1).all():  # False for NaN
            wrong = numbers[~(np.abs(numbers) <= 1)].flat[0]
            raise InvalidActionError(f"{name}: {wrong} must lie in -1..1, as np.clip(..., -1, 1) makes it")
        outputs[:] = numbers * SCALES
        return self._nothing
