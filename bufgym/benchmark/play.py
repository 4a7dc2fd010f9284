"""A fixed policy as the player of an environment, decision by decision."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bufgym.envs.step import action_of
from bufgym.errors import BufgymError
from bufgym.model.buffer import HOLD
from bufgym.policies import Policy
from bufgym.sim import ARRIVAL_WAITS, SOCKET_WAITS, Senders, answer_of, named, python_arrival, python_view


class Player:
    """Owns a policy's memory for each of ``n`` senders and turns its decisions into an environment's actions.

    Just before a decision the policy is called once for every departure since the one before, with the buffer as it is
    now. Its uniform draws are the episode's; where an environment drew the episode, they come from its seed. It is
    asked at arrivals, and with several topics for what to send next. A policy that drops at dequeue, or has an
    unbounded queue, can't play: a BufgymError says so.
    """

    def __init__(self, policy: Policy, n: int = 1) -> None:
        if policy.drops_at_dequeue or policy.unbounded:
            reason = "drops at dequeue" if policy.drops_at_dequeue else "has an unbounded queue"
            raise BufgymError(f"policy {policy.name} {reason}: it can be benchmarked, but not play in an environment")
        self.policy = policy
        self._parameters = policy.parameter_array
        self._memory: list[NDArray[np.float64] | None] = [None] * n
        self._dequeued = np.zeros(n, np.int64)

    def begin(self, i: int = 0) -> None:
        """Forget everything about sender ``i``: a new episode begins there."""
        self._memory[i] = None
        self._dequeued[i] = 0

    def action(self, senders: Senders, i: int = 0) -> int:
        """The action for sender ``i``, whose decision is due: 0..L-1 evict, L reject, L + 1 accept.

        Where the socket asks: 0..L-1 send, L hold. BufgymError where no decision is due, or the policy gave none.
        """
        senders.draw_uniforms(i)
        batch = named(senders.batch._replace(parameters=self._parameters))
        sender = batch.senders[i]
        if sender.waiting not in (ARRIVAL_WAITS, SOCKET_WAITS):
            raise BufgymError(f"sender {i}: no decision is due")
        buffer = python_view(batch, i)
        memory = self._memory[i]
        if memory is None:
            memory = self._memory[i] = senders.new_memory(self.policy, i)
        if self.policy.hears_departures:
            for _ in range(int(sender.dequeued - self._dequeued[i])):
                self.policy.on_departure(buffer, memory)
        self._dequeued[i] = sender.dequeued
        if sender.waiting == SOCKET_WAITS:
            choice = answer_of(self.policy, "on_send", self.policy.on_send(buffer, memory))
            if not HOLD <= choice < senders.capacity:
                raise BufgymError(
                    f"policy {self.policy.name}: sends slot {choice}: must be 0..{senders.capacity - 1}, or HOLD"
                )
            return senders.capacity if choice == HOLD else choice
        answer = self.policy.on_arrival(buffer, python_arrival(batch, i), memory)
        decision = answer_of(self.policy, "on_arrival", answer)
        try:
            return action_of(decision, senders.capacity)
        except BufgymError as error:
            raise BufgymError(f"policy {self.policy.name}: {error}") from None
