"""A fixed policy as the player of an environment, decision by decision."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel, named
from bufgym.model.buffer import ACCEPT, HOLD
from bufgym.policies import Policy
from bufgym.sim import Senders
from bufgym.sim.rollout import answer_of, python_arrival, python_view
from bufgym.sim.state import ARRIVAL_WAITS, NOTHING_WAITS, SOCKET_WAITS, Batch
from bufgym.sim.view import arrival_of, view
from bufgym.utils.errors import BufgymError


def as_actions(answers: NDArray[np.int64], capacity: int) -> NDArray[np.int64]:
    """A policy's answers as actions: 0..L-1 for a slot, L + 1 for ACCEPT, L for REJECT and HOLD."""
    return np.where(answers >= 0, answers, np.where(answers == ACCEPT, capacity + 1, capacity))


class Player:
    """Owns a policy's ``memory``, float64[n, entries], and turns its decisions into an environment's actions.

    Just before a decision the policy is called once for every departure since the last one, with the buffer as it is
    now. Uniform draws belong to the episode; if an environment drew the episode, they come from its seed. The policy is
    asked once per decision: at arrivals and, with several topics, for the message to send next. It forgets everything
    at a new episode. A policy that drops at dequeue or has an unbounded queue raises a BufgymError.
    """

    def __init__(self, policy: Policy, n: int = 1) -> None:
        if policy.drops_at_dequeue or policy.unbounded:
            reason = "drops at dequeue" if policy.drops_at_dequeue else "has an unbounded queue"
            raise BufgymError(f"policy {policy.name} {reason}: it can be benchmarked, but not play in an environment")
        self.policy = policy
        self._parameters = policy.parameter_array
        self._functions = policy.compiled if policy.compile else None
        self.memory = np.zeros((n, 1))
        self._begun = np.zeros(n, np.int64)
        self._heard = np.zeros(n, np.int64)

    def action(self, senders: Senders, i: int = 0) -> int:
        """The action for sender ``i``, whose decision is due: 0..L-1 evict, L reject, L + 1 accept.

        Where the socket asks, 0..L-1 send and L holds. BufgymError if no decision is due or the policy gave no valid
        one.
        """
        if senders.batch.senders["waiting"][i] not in (ARRIVAL_WAITS, SOCKET_WAITS):
            raise BufgymError(f"sender {i}: no decision is due")
        self._begin(senders, np.array([i]))
        batch = named(senders.batch._replace(parameters=self._parameters))
        sender, buffer, memory = batch.senders[i], python_view(batch, i), self.memory[i]
        if self.policy.hears_departures:
            for _ in range(int(sender.dequeued - self._heard[i])):
                self.policy.on_departure(buffer, memory)
        self._heard[i] = sender.dequeued
        sends = bool(sender.waiting == SOCKET_WAITS)
        if sends:
            answer = answer_of(self.policy, "on_send", self.policy.on_send(buffer, memory))
        else:
            answer = self.policy.on_arrival(buffer, python_arrival(batch, i), memory)
            answer = answer_of(self.policy, "on_arrival", answer)
        return int(self._checked(np.array([answer]), senders.capacity, sends=sends)[0])

    def actions(self, senders: Senders, rows: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """int64[n]: ``action`` of every sender in ``rows`` (by default all) whose decision is due, L elsewhere.

        A compiled policy takes one compiled call.
        """
        waiting = senders.batch.senders["waiting"]
        # Whole numbers of another size would be misread.
        rows = np.arange(len(senders)) if rows is None else np.ascontiguousarray(rows, np.int64)
        rows = rows[waiting[rows] != NOTHING_WAITS]
        actions = np.full(len(senders), senders.capacity)
        if self._functions is None:
            actions[rows] = [self.action(senders, i) for i in rows.tolist()]
            return actions
        self._begin(senders, rows)
        batch = senders.batch._replace(parameters=self._parameters)
        on_arrival, on_departure, _, on_send = self._functions
        hears, answers = self.policy.hears_departures, actions.copy()
        ask(batch, self.memory, self._heard, rows, on_arrival, on_departure, on_send, hears, answers)
        for sends in (False, True):
            asked = rows[waiting[rows] == (SOCKET_WAITS if sends else ARRIVAL_WAITS)]
            actions[asked] = self._checked(answers[asked], senders.capacity, sends=sends)
        return actions

    def _begin(self, senders: Senders, rows: NDArray[np.int64]) -> None:
        """Give fresh memory to the ``rows`` that have begun another episode."""
        for i in rows[self._begun[rows] != senders.begun[rows]].tolist():
            senders.draw_uniforms(i)
            memory = senders.new_memory(self.policy, i)
            if len(memory) > self.memory.shape[1]:
                wider = np.zeros((len(self.memory), len(memory)))
                wider[:, : self.memory.shape[1]] = self.memory
                self.memory = wider
            self.memory[i] = 0.0
            self.memory[i, : len(memory)] = memory
            self._heard[i] = 0
            self._begun[i] = senders.begun[i]

    def _checked(self, answers: NDArray[np.int64], capacity: int, *, sends: bool) -> NDArray[np.int64]:
        """Actions for the policy's answers at arrivals. Where the socket asks, for the slot it ``sends``."""
        wrong = answers[(answers < (HOLD if sends else ACCEPT)) | (answers >= capacity)]
        if len(wrong):
            what, last = ("sends slot", "or HOLD") if sends else ("decision", "REJECT or ACCEPT")
            slots = f"0..{capacity - 1}," if sends else f"a slot 0..{capacity - 1},"
            raise BufgymError(f"policy {self.policy.name}: {what} {wrong[0]}: must be {slots} {last}")
        return as_actions(answers, capacity)


@kernel
def ask(
    batch: Batch,
    memory: NDArray[np.float64],
    heard: NDArray[np.int64],
    rows: NDArray[np.int64],
    on_arrival: Any,
    on_departure: Any,
    on_send: Any,
    hears_departures: bool,
    answers: NDArray[np.int64],
) -> None:
    """Write the policy's answer for each of ``rows`` into ``answers``; ``heard``, int64[n], counts departures."""
    for i in rows:
        sender = batch.senders[i]
        buffer = view(batch, i)
        if hears_departures:
            for _ in range(sender.dequeued - heard[i]):
                on_departure(buffer, memory[i])
        heard[i] = sender.dequeued
        if sender.waiting == SOCKET_WAITS:
            answers[i] = on_send(buffer, memory[i])
        else:
            answers[i] = on_arrival(buffer, arrival_of(batch, i), memory[i])
