"""Senders that hold episodes, and the main loop for a fixed policy."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from bufgym.errors import BufgymError
from bufgym.kernel import compile_for, records
from bufgym.model.buffer import MESSAGE, TOPIC, UNLIMITED_BYTES, check_limits, row_width
from bufgym.model.link import FOREVER, Knots
from bufgym.model.qoi import Value
from bufgym.model.topics import Topic, check_topics, copies_of, topic_table
from bufgym.policies.registry import Policy, runs_compiled, signatures
from bufgym.scenario import Episode
from bufgym.sim.decisions import answer_dequeue, answer_send, decide
from bufgym.sim.socket import credit
from bufgym.sim.state import DECISION, DEPARTURE, DEQUEUE, END, LOG_ENTRY, SEND, SENDER, Batch, batch_type, named
from bufgym.sim.transition import load_row, next_event
from bufgym.sim.view import arrival_of, view


def rollout(
    batch: Batch,
    memory: NDArray[np.float64],
    on_arrival: Any,
    on_departure: Any,
    on_dequeue: Any,
    on_send: Any,
    hears_departures: bool,
) -> None:
    """Run every sender of the batch to its end under one policy; ``memory`` is float64[n, entries]."""
    for i in range(len(batch.senders)):
        event = next_event(batch, i)
        while event != END:
            if event == DECISION:
                decide(batch, i, on_arrival(view(batch, i), arrival_of(batch, i), memory[i]))
            elif event == DEQUEUE:
                answer_dequeue(batch, i, on_dequeue(view(batch, i), memory[i]))
            elif event == SEND:
                answer_send(batch, i, on_send(view(batch, i), memory[i]))
            elif hears_departures:
                on_departure(view(batch, i), memory[i])
            event = next_event(batch, i)
        credit(batch, i, FOREVER)


@functools.cache
def compiled_rollout() -> Any:
    """``rollout`` compiled once for every policy (policies arrive as values of one function type)."""
    functions = tuple(numba.types.FunctionType(signature) for signature in signatures())
    memory = numba.types.Array(numba.types.float64, 2, "C")
    return compile_for(numba.types.void(batch_type(), memory, *functions, numba.types.boolean), rollout)


class Senders:
    """A batch of n senders that share L, B and V, each with an episode of its own."""

    def __init__(
        self,
        n: int,
        capacity: int,
        v: Value,
        *,
        max_messages: int,
        max_bytes: int | None = None,
        decide_at: str = "arrival",
        topics: Sequence[Topic] = (),
    ) -> None:
        """n senders with room for L = ``capacity`` messages (and B = ``max_bytes`` bytes), without episodes yet.

        ``topics``: the rules of each topic, by the topic numbers of the messages; none for one queue without rules.
        """
        check_limits(capacity, max_bytes)
        if decide_at not in ("arrival", "overflow"):
            raise BufgymError(f"decide_at = {decide_at!r}: must be 'arrival' or 'overflow'")
        self.capacity = int(capacity)
        self.max_bytes = UNLIMITED_BYTES if max_bytes is None else int(max_bytes)
        self.decide_at = decide_at
        self.value = v
        self.topics = check_topics(topics)
        self._topic_table, values = topic_table(self.topics, self.capacity, v)
        self.episodes: list[Episode | None] = [None] * n
        self._knots = Knots()
        self.batch = Batch(
            records(n, SENDER),
            records((n, row_width(self.capacity)), MESSAGE),
            records((n, max_messages), MESSAGE),
            records((n, max_messages), LOG_ENTRY),
            np.zeros((n, max_messages), np.int64),
            self._knots.us,
            self._knots.bytes,
            values,
            records((n, len(self._topic_table)), TOPIC),
        )

    def __len__(self) -> int:
        return len(self.episodes)

    def load(self, i: int, episode: Episode) -> None:
        """Begin ``episode`` at sender ``i``: empty buffer, idle socket, nothing arrived."""
        link = episode.link
        if len(episode.arrivals) > self.batch.arrivals.shape[1]:
            most = self.batch.arrivals.shape[1]
            raise BufgymError(f"episode of {len(episode.arrivals)} messages: these senders have room for {most}")
        numbers = episode.arrivals["topic"]
        if self.topics and not (numbers.min() >= 0 and numbers.max() < len(self.topics)):
            unknown = numbers.min() if numbers.min() < 0 else numbers.max()
            raise BufgymError(f"episode: unknown topic {unknown}; the senders know {len(self.topics)}, from 0 on")
        first_knot, last_knot, after = self._knots.place(link.trace, i)
        if self._knots.us is not self.batch.knot_us:
            self.batch = self.batch._replace(knot_us=self._knots.us, knot_bytes=self._knots.bytes)
        self.episodes[i] = episode
        load_row(
            self.batch,
            i,
            episode.arrivals,
            self._topic_table,
            (self.capacity, self.max_bytes, int(self.decide_at == "overflow")),
            (episode.first_decision, episode.last_decision),
            (first_knot, last_knot, after, link.offset_us, link.propagation_us),
            (episode.window, episode.ack_delay_us),
        )

    def new_memory(self, policy: Policy, i: int) -> NDArray[np.float64]:
        """Fresh memory of ``policy`` for the episode of sender ``i``, float64[entries]."""
        memory: NDArray[np.float64] = policy.new_memory(1, self.capacity)[0]
        if policy.privileged is not None:
            memory = policy.privileged(self.episodes[i], self.capacity, self.max_bytes, self.value)
        return memory

    def run(self, policy: Policy, memory: NDArray[np.float64] | None = None) -> None:
        """Run every loaded sender to its end under ``policy``; ``memory``: float64[n, entries], fresh by default."""
        if memory is None:
            rows = range(len(self)) if policy.privileged is not None else ()
            memory = (
                padded([self.new_memory(policy, i) for i in rows])
                if rows
                else policy.new_memory(len(self), self.capacity)
            )
        senders = self.batch.senders
        senders["ask_at_dequeue"], senders["ask_at_send"] = policy.drops_at_dequeue, policy.schedules
        senders["limit_at_send"], senders["flush_no_drop"] = policy.client.limit_at_send, policy.client.flush_no_drop
        if not policy.client.awaits_acks:
            senders["window"], senders["ack_delay_us"] = 1, 0
        batch = self.batch._replace(parameters=policy.parameter_array)
        if runs_compiled(policy):
            compiled_rollout()(batch, memory, *policy.compiled, policy.hears_departures)
        else:
            python_rollout(batch, memory, policy)


def padded(rows: Sequence[NDArray[Any]]) -> NDArray[np.float64]:
    """Rows of different lengths as one array, filled up with zeros."""
    made = np.zeros((len(rows), max(map(len, rows))))
    for i, row in enumerate(rows):
        made[i, : len(row)] = row
    return made


python_view = getattr(view, "py_func", view)
"""``view`` for Python callers, over a ``named`` batch: the compiled kernel must not hand its arrays to Python."""


def answer_of(policy: Policy, hook: str, given: Any) -> int:
    """What a policy that is ordinary Python gave, a whole number (or a yes or no); a BufgymError for anything else."""
    try:
        number = int(given)
    except (TypeError, ValueError, OverflowError):
        number = None
    if number is None or number != given:
        raise BufgymError(f"policy {policy.name}: {hook} returned {given!r}: must be a whole number")
    return number


def ask(
    policy: Policy,
    batch: Batch,
    seen: Batch,
    i: int,
    event: int,
    memory: NDArray[np.float64],
    decide: Callable[[Batch, int, int], object],
) -> None:
    """Tell a policy that is ordinary Python of an event of sender ``i`` and carry its answer out.

    ``seen``: the same batch, ``named``; ``memory``: float64[entries]; ``decide``: what carries a DECISION out.
    """
    if event == DEPARTURE and not policy.hears_departures:
        return
    shown = python_view(seen, i)
    if event == DECISION:
        answer = policy.on_arrival(shown, seen.arrivals[i, seen.senders[i].next], memory)
        decide(batch, i, answer_of(policy, "on_arrival", answer))
    elif event == DEQUEUE:
        answer_dequeue(batch, i, bool(answer_of(policy, "on_dequeue", policy.on_dequeue(shown, memory))))
    elif event == SEND:
        answer_send(batch, i, answer_of(policy, "on_send", policy.on_send(shown, memory)))
    else:
        policy.on_departure(shown, memory)


def python_rollout(batch: Batch, memory: NDArray[np.float64], policy: Policy) -> None:
    """``rollout`` for a policy that is ordinary Python: the transition stays compiled, views are made in Python."""
    seen = named(batch)
    for i in range(len(batch.senders)):
        event = next_event(batch, i)
        while event != END:
            ask(policy, batch, seen, i, event, memory[i], decide)
            event = next_event(batch, i)
        credit(batch, i, FOREVER)


def run(
    policy: Policy,
    episodes: Sequence[Episode],
    capacity: int,
    v: Value,
    *,
    max_bytes: int | None = None,
    decide_at: str = "arrival",
    memory: NDArray[np.float64] | None = None,
    topics: Sequence[Topic] = (),
) -> Senders:
    """The senders after ``policy`` met each of ``episodes``, one sender each; an unbounded policy has L = all."""
    if not episodes:
        raise BufgymError("no episode to run")
    if policy.client.encoding:
        episodes = [episode.encoded(policy.client.encoding) for episode in episodes]
    if policy.client.copies and topics:
        copies = max(episode.consumers for episode in episodes)
        episodes = [episode.copied(len(topics)) for episode in episodes]
        topics = copies_of(topics, copies)
    longest = max(len(episode.arrivals) for episode in episodes)
    if policy.unbounded:
        capacity = longest
        topics = [replace(topic, limit=None) for topic in topics]
    senders = Senders(
        len(episodes), capacity, v, max_messages=longest, max_bytes=max_bytes, decide_at=decide_at, topics=topics
    )
    for i, episode in enumerate(episodes):
        senders.load(i, episode)
    senders.run(policy, memory)
    return senders
