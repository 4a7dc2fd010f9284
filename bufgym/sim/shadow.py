"""Shadow senders: beside each sender of a batch another one, on the same episode, where a rule decides.

A shadow is run to the arrival that its sender has come to. There both have seen the same arrivals and the same link, so
what one has kept can be compared with what the other has, whatever each was asked.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym import policies
from bufgym.jit import kernel, records
from bufgym.model.buffer import MESSAGE, TOPIC
from bufgym.sim.rollout import ask
from bufgym.sim.senders import Senders
from bufgym.sim.state import DECISION, DEPARTURE, END, LOG_ENTRY, SENDER, Batch
from bufgym.sim.transition import next_event
from bufgym.utils.errors import BufgymError


@kernel
def catch_up(
    batch: Batch,
    i: int,
    arrival: int,
    memory: NDArray[np.float64],
    on_arrival: Any,
    on_departure: Any,
    on_dequeue: Any,
    on_send: Any,
    hears_departures: bool,
) -> None:
    """Run sender ``i`` under a rule until arrival number ``arrival`` asks, undecided, or else to its end."""
    event = next_event(batch, None, i)
    while event != END and not (event == DECISION and batch.senders[i].next >= arrival):
        if event != DEPARTURE or hears_departures:
            ask(batch, i, event, memory[i], on_arrival, on_departure, on_dequeue, on_send)
        event = next_event(batch, None, i)


class Shadows:
    """A shadow beside each of ``senders``, of one queue each with a link of its own, under one compiled rule.

    Shadows ask their rule at every arrival, as benchmarks do. They share episodes and links with their senders and have
    queues, logs and clocks of their own. ``memory`` is the rule's, float64[n, entries].
    """

    def __init__(self, senders: Senders, rule: str | policies.Policy, who: str) -> None:
        """``rule`` is a policy or its name; errors begin with ``who`` asks."""
        policy = policies.get(rule)
        if (why := _unfit(policy)) is not None:
            raise BufgymError(f"{who}: policy {policy.name!r} {why}")
        self.policy, self._senders, n = policy, senders, len(senders)
        self._own: dict[str, Any] = {
            "senders": records(n, SENDER),
            "slots": records(senders.batch.slots.shape, MESSAGE),
            "log": records(senders.batch.log.shape, LOG_ENTRY),
            "order": np.zeros(senders.batch.order.shape, np.int64),
            "topics": records(senders.batch.topics.shape, TOPIC),
            "past": np.zeros(senders.batch.past.shape),
            "parameters": policy.parameter_array,
        }
        self._seen = senders.batch
        self._batch = senders.batch._replace(**self._own)
        self._fresh = policy.new_memory(1, senders.capacity)
        self.memory = np.repeat(self._fresh, n, 0)

    @property
    def batch(self) -> Batch:
        """The shadows' arrays; those of episodes and links are their senders'."""
        if self._seen is not self._senders.batch:  # links or values came to it, in longer arrays
            self._seen = self._senders.batch
            self._batch = self._seen._replace(**self._own)
        return self._batch

    def begin(self, rows: NDArray[np.int64]) -> None:
        """Begin the episodes that these senders have just loaded and not yet begun to play."""
        for i in rows.tolist():
            self._senders.draw_uniforms(i)
        shadows, of = self.batch, self._senders.batch
        for own, theirs in ((shadows.senders, of.senders), (shadows.topics, of.topics)):
            # whole words are copied faster than records
            own.view(np.int64).reshape(len(own), -1)[rows] = theirs.view(np.int64).reshape(len(own), -1)[rows]
        shadows.past[rows] = 0.0
        shadows.senders["ask_when_full"][rows] = 0
        self._senders.follow(self.policy, shadows.senders)
        self.memory[rows] = self._fresh


def _unfit(policy: policies.Policy) -> str | None:
    """Why no shadow can play ``policy``; None if one can."""
    if not policy.ranked:
        return f"is none that a robot could have instead: {policy.unranked_because}"
    if policy.for_topics:
        return "is made for several topics"
    if policy.client.encoding:
        return "sends other messages than those of the episode"
    return None if policy.compile else "runs as plain Python: register it with compile=True"
