"""A fixed policy as the player of an environment, decision by decision."""

from __future__ import annotations

import numpy as np

from bufgym.buffer import ACCEPT, REJECT
from bufgym.errors import BufgymError
from bufgym.policies import Policy
from bufgym.sender import Senders, named, python_view


class Player:
    """Owns a policy's memory for each of ``n`` senders and turns its decisions into an environment's actions.

    The policy hears of departures just before its next decision, as often as there were some, and sees the buffer as
    it is then. Luck is that of the episode (see ``Episode.with_luck``).
    """

    def __init__(self, policy: Policy, n: int = 1) -> None:
        self.policy = policy
        self._memory = policy.new_memory(n)
        self._taken = np.zeros(n, np.int64)

    def begin(self, i: int = 0) -> None:
        """Forget everything about sender ``i``: a new episode begins there."""
        self._memory[i] = self.policy.new_memory()[0]
        self._taken[i] = 0

    def action(self, senders: Senders, i: int = 0) -> int:
        """The action for sender ``i``, whose decision is due: 0..L-1 evict, L reject, L + 1 accept."""
        batch = named(senders.batch)
        sender = batch.senders[i]
        if sender.waiting != 1:
            raise BufgymError(f"sender {i}: no decision is due")
        seen = python_view(batch, i)
        memory = self._memory[i]
        if self.policy.hears_departures:
            for _ in range(int(sender.taken - self._taken[i])):
                self.policy.on_departure(seen, memory)
        self._taken[i] = sender.taken
        decision = int(self.policy.on_arrival(seen, batch.arrivals[i, sender.next], memory))
        if 0 <= decision < senders.capacity:
            return decision
        if decision == REJECT:
            return senders.capacity
        if decision == ACCEPT:
            return senders.capacity + 1
        allowed = f"a slot 0..{senders.capacity - 1}, REJECT or ACCEPT"
        raise BufgymError(f"policy {self.policy.name}: decision {decision}: must be {allowed}")
