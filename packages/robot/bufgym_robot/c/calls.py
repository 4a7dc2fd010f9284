"""Calls of a program in an episode with the simulator's decisions, the reference for the header's C."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel, records, unchecked_at
from bufgym.model.link import FOREVER, Link
from bufgym.model.qoi import Value
from bufgym.policies.registry import Policy
from bufgym.scenario import Episode, messages
from bufgym.sim import Senders
from bufgym.sim.decisions import answer_dequeue, decide
from bufgym.sim.state import DECISION, DEPARTURE, END, Batch
from bufgym.sim.state import DEQUEUE as DEQUEUE_ASKS
from bufgym.sim.transition import next_event
from bufgym.sim.view import arrival_of, view
from bufgym.traces import Trace

INIT, ARRIVAL, HEAD, DEQUEUE, SENT, ENDS = range(6)  # Kinds of calls, as in ``parts/parity.h``

CALL = np.dtype(
    [
        ("kind", np.int64),
        ("at_us", np.int64),
        ("size_bytes", np.int64),  # of the message that arrives or has been sent
        ("left_bytes", np.int64),  # in the socket, at an arrival
        ("decision", np.int64),  # the policy's, at an arrival
        ("x", np.float64),
        ("uniform", np.float64),
    ],
    align=True,
)
"""``struct bufgym_call``."""


@kernel
def _note(calls: NDArray[Any], n: int, kind: int, at_us: int, size_bytes: int) -> int:
    """Write call ``n``; return the new number of calls."""
    call = calls[n]
    call.kind, call.at_us, call.size_bytes = kind, at_us, size_bytes
    call.left_bytes, call.decision, call.x, call.uniform = 0, 0, 0.0, 0.0
    return n + 1


@kernel
def _record(
    batch: Batch,
    memory: Any,
    on_arrival: Any,
    on_departure: Any,
    on_dequeue: Any,
    hears_departures: bool,
    calls: NDArray[Any],
) -> int:
    """Run every sender of the batch to its end, record the calls and return their number."""
    n = 0
    for i in range(len(batch.senders)):
        n = _note(calls, n, INIT, 0, 0)
        if batch.senders[i].ends_us < FOREVER:
            n = _note(calls, n, ENDS, batch.senders[i].ends_us, 0)
        event, sent = next_event(batch, None, i), 0
        while event != END:
            sender = batch.senders[i]
            while sent < sender.transmitted:
                place = unchecked_at(batch.order, i, sent)
                n = _note(
                    calls,
                    n,
                    SENT,
                    unchecked_at(batch.log, i, place).transmitted_us,
                    unchecked_at(batch.arrivals, i, place).size_bytes,
                )
                sent += 1
            buffer = view(batch, i)
            if event == DECISION:
                arrival = arrival_of(batch, i)
                decision = on_arrival(buffer, arrival, memory[i])
                n = _note(calls, n, ARRIVAL, arrival.arrival_us, arrival.size_bytes)
                calls[n - 1].x, calls[n - 1].left_bytes, calls[n - 1].decision = arrival.x, buffer.left_bytes, decision
                calls[n - 1].uniform = arrival.uniform
                decide(batch, i, decision)
            elif event == DEQUEUE_ASKS:
                n = _note(calls, n, HEAD, sender.now_us, 0)
                drops = on_dequeue(buffer, memory[i])
                calls[n - 1].decision = int(drops)
                answer_dequeue(batch, i, drops)
            elif event == DEPARTURE:
                n = _note(calls, n, DEQUEUE, sender.now_us, 0)
                if hears_departures:
                    on_departure(buffer, memory[i])
            event = next_event(batch, None, i)
    return n


def recorded(
    policy: Policy, episodes: Sequence[Episode], capacity: int, value: Value, max_bytes: int | None = None
) -> NDArray[Any]:
    """Record CALL[calls] of the episodes in turn, under a policy of one queue.

    No message may be larger than B, because such a message is dropped without a call.
    """
    longest = max(len(episode.arrivals) for episode in episodes)
    senders = Senders(len(episodes), capacity, value, max_messages=longest, max_bytes=max_bytes)
    senders.load_all([(i, episode, None) for i, episode in enumerate(episodes)])
    senders.follow(policy)
    senders.batch.senders["shows_left"] = 1
    # An arrival may need as many evictions as the queue holds, but each message is evicted only once.
    most = sum(2 + 6 * len(episode.arrivals) for episode in episodes)
    calls = records(most, CALL)
    on_arrival, on_departure, on_dequeue, _ = policy.compiled
    batch = senders.batch._replace(parameters=policy.parameter_array)
    memory = policy.new_memory(len(episodes), capacity)
    n = _record(batch, memory, on_arrival, on_departure, on_dequeue, policy.hears_departures, calls)
    return calls[:n]


def random_episode(rng: np.random.Generator, n: int, largest_bytes: int | None = None) -> Episode:
    """Draw n messages with random times, sizes up to the largest and motion, on a link of changing rate.

    In every second episode the robot is told, rightly or not, when the stream ends.
    """
    period_us, size_bytes = rng.choice([10_000, 33_333, 100_000]), int(rng.choice([2_000, 60_000, 230_000]))
    jitter, spread = rng.choice([0.0, 0.3, 3.0]), rng.choice([0.0, 0.5])
    step_us = rng.gamma(1 / jitter, period_us * jitter, n) if jitter > 0 else np.full(n, period_us)
    sizes = np.clip(size_bytes * np.exp(rng.normal(0, spread, n)), 1, largest_bytes)
    step = np.ones(n) if rng.random() < 0.3 else rng.gamma(0.5, 2.0, n) * (rng.random(n) < 0.8)
    demand = 1e6 * size_bytes / period_us
    seconds = rng.uniform(2, 40, 12) * period_us / 1e6
    shares = rng.choice([0.0, 0.1, 0.5, 0.9, 1.5], 12)
    shares[0] = 1.5  # the link carries something
    trace = Trace.steps([(s, share * demand) for s, share in zip(seconds, shares, strict=True)])
    arrivals = messages(np.cumsum(step_us).astype(np.int64), sizes.astype(np.int64), np.cumsum(step))
    link = Link(trace, offset_us=int(rng.integers(trace.duration_us)))
    ends_us = int(arrivals["arrival_us"][-1] * rng.uniform(0.5, 1.5)) if rng.random() < 0.5 else None
    return Episode(arrivals, link, ends_us=ends_us)
