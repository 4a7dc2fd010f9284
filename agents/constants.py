"""What needs no learning: one action always, and chance, among the ordered candidates at a full buffer.

A trained agent is worth something as far as it is above the better constant action. The head always is no row of its
own: that is Drop Oldest.
"""

from bufgym.jit import kernel
from bufgym.model.buffer import ACCEPT, Buffer, has_space
from bufgym.model.observe import decision_of_candidate, find_candidates
from bufgym.policies import Policy
from bufgym.policies.classic import uniform_draw
from bufgym.policies.registry import Arrival, Memory

PLACES = 3
"""Actions at a full buffer: the cheapest candidate, the second cheapest, the head."""
CHANCE = -1
"""In place of an action: one of them, equally likely."""


@kernel
def on_arrival(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """The decision of the same action at every full buffer, or of a random one."""
    if has_space(buffer, arrival):
        return ACCEPT
    order, cost = memory[:PLACES], memory[PLACES : 2 * PLACES]
    find_candidates(buffer, arrival, order, cost)
    action = int(buffer.parameters[0])
    if action == CHANCE:
        action = int(uniform_draw(buffer, arrival) * PLACES)
    return int(decision_of_candidate(order, len(buffer.slots), False, False, action))


def _always(name: str, action: int) -> Policy:
    return Policy(name, on_arrival, weights=(float(action),), work=(2 * PLACES, 0), compile=True, about=name)


CONSTANT = tuple(_always(f"always {action}", action) for action in range(PLACES - 1))
"""The cheapest always, which is the rule min-motion-gap where sizes are equal; the second cheapest always."""
UNTAUGHT = (*CONSTANT, _always("chance", CHANCE))
NAMES = tuple(policy.name for policy in UNTAUGHT)
