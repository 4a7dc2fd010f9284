"""The sender: one transition function for a batch of senders, and the main loop for a fixed policy.

Order of things at an arrival at time t: (1) everything the link finishes up to and including t leaves, and successors
start; (2) the policy decides; (3) if the socket is idle it takes the head at once. After the last arrival the buffer
drains. Nothing sent is lost (TCP); the message in transmission is outside the buffer.

``next_event`` moves one sender to the next thing that somebody must hear of: the socket took a message (DEPARTURE), an
arrival asks for a decision (DECISION), or it is over (END). ``decide`` carries a decision out. Environments, rollouts
and benchmarks are loops around these two. Queue disciplines that drop at the head, such as CoDel, are asked there too
(DEQUEUE, ``answer_dequeue``).
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numba
import numpy as np
from numpy.typing import NDArray

from bufgym.buffer import (
    ACCEPT,
    MESSAGE,
    REJECT,
    UNLIMITED_BYTES,
    Buffer,
    check_limits,
    evict,
    push,
    row_width,
)
from bufgym.errors import BufgymError
from bufgym.kernel import compile_for, kernel, records
from bufgym.link import FOREVER, Knots, position_at, time_of
from bufgym.policies.registry import Policy, runs_compiled, signatures
from bufgym.qoi import Value, value
from bufgym.scenario import Episode

END, DEPARTURE, DECISION, DEQUEUE = range(4)

SENDER = np.dtype(
    [
        # what the sender is
        ("capacity", np.int64),  # L, messages
        ("max_bytes", np.int64),  # B, bytes
        ("ask_when_full", np.int64),  # 1: only an arrival that finds no room asks for a decision
        ("ask_at_dequeue", np.int64),  # 1: the policy may drop the head before the socket takes it
        # its episode
        ("arrivals", np.int64),  # messages in all
        ("first_decision", np.int64),
        ("last_decision", np.int64),
        ("first_knot", np.int64),
        ("last_knot", np.int64),
        ("after", np.int64),
        ("offset_us", np.int64),
        ("propagation_us", np.int64),
        # its clock
        ("now_us", np.int64),
        ("next", np.int64),  # the next arrival, or the one that waits for a decision
        ("waiting", np.int64),  # 1 while a decision is due
        # its buffer
        ("first", np.int64),  # column of the head
        ("occupancy", np.int64),
        ("backlog_bytes", np.int64),
        # its socket
        ("busy", np.int64),
        ("cleared", np.int64),  # 1: the head may go; nobody need be asked again
        ("follows", np.int64),  # 1: the head follows the message before it without a pause
        ("position", np.int64),  # bytes of the trace used up when the message in transmission has crossed
        ("finish_us", np.int64),
        ("segment_now", np.int64),  # where on the trace the clock and the socket were last looked up
        ("segment_finish", np.int64),
        # counts
        ("taken", np.int64),  # messages the socket took
        ("crossed", np.int64),  # messages that left the socket
        ("credited", np.int64),  # messages that reached the server
        ("rejected", np.int64),
        ("evicted", np.int64),
        ("impossible", np.int64),  # decisions that could not be carried out as given
        ("peak_backlog_bytes", np.int64),  # queued at most
        # what the policy may know of its own past
        ("previous_us", np.int64),
        ("previous_x", np.float64),
        ("taken_at_us", np.int64),  # when the socket last took a message
        ("departures", np.int64),
        ("period_us", np.float64),
        ("drain", np.float64),
        # information
        ("delivered_gain", np.float64),  # sum of V over what reached the server
        ("retained_gain", np.float64),  # sum of V over what is kept or sent
    ],
    align=True,
)

FATE = np.dtype(
    [
        ("taken_us", np.int64),  # the socket took it out of the buffer
        ("crossed_us", np.int64),  # its last byte crossed the link
        ("dropped_us", np.int64),  # it was evicted or rejected
        ("gain", np.float64),  # V that its delivery adds; it is settled once the socket has taken it
    ],
    align=True,
)
NEVER = -1
"""In FATE: it did not happen."""

# Weights of the running means: about the last 8 arrivals for the period, 16 for the drain.
_PERIOD_WEIGHT, _DRAIN_WEIGHT = 1 / 8, 1 / 16


class Batch(NamedTuple):
    """The arrays of n senders, changed in place by the kernels. A snapshot is a copy of them."""

    senders: NDArray[Any]
    """SENDER[n]"""
    slots: NDArray[Any]
    """MESSAGE[n, 1 + 2 L] (see ``bufgym.buffer``)"""
    arrivals: NDArray[Any]
    """MESSAGE[n, messages]"""
    fates: NDArray[Any]
    """FATE[n, messages]"""
    order: NDArray[np.int64]
    """[n, messages]: sequence numbers in the order in which the link carried them."""
    knot_us: NDArray[np.int64]
    knot_bytes: NDArray[np.int64]
    v: NDArray[np.float64]


# --- the transition --------------------------------------------------------------------------------------------------


@kernel
def load_row(
    batch: Batch,
    i: int,
    arrivals: NDArray[Any],
    buffer: tuple[int, int, int],
    decisions: tuple[int, int],
    link: tuple[int, int, int, int, int],
) -> None:
    """Put sender ``i`` at the beginning of an episode: empty buffer, idle socket, nothing arrived.

    ``buffer``: capacity, max_bytes, ask_when_full; ``decisions``: first and last arrival that asks for one; ``link``:
    first and last knot, what follows the end, offset_us, propagation_us.
    """
    for k in range(len(arrivals)):
        batch.arrivals[i, k] = arrivals[k]
        fate = batch.fates[i, k]
        fate.taken_us, fate.crossed_us, fate.dropped_us = NEVER, NEVER, NEVER
    sender = batch.senders[i]
    sender.capacity, sender.max_bytes, sender.ask_when_full = buffer
    sender.first_decision, sender.last_decision = decisions
    sender.first_knot, sender.last_knot, sender.after, sender.offset_us, sender.propagation_us = link
    sender.segment_now, sender.segment_finish = sender.first_knot, sender.first_knot
    sender.arrivals = len(arrivals)
    sender.first = 1
    sender.now_us, sender.next, sender.waiting, sender.occupancy, sender.backlog_bytes = 0, 0, 0, 0, 0
    sender.busy, sender.position, sender.finish_us = 0, 0, 0
    sender.ask_at_dequeue, sender.cleared, sender.follows = 0, 0, 0
    sender.taken, sender.crossed, sender.credited = 0, 0, 0
    sender.rejected, sender.evicted, sender.impossible, sender.peak_backlog_bytes = 0, 0, 0, 0
    sender.previous_us, sender.taken_at_us, sender.departures = 0, 0, 0
    sender.previous_x, sender.period_us, sender.drain = 0.0, 0.0, 0.0
    sender.delivered_gain, sender.retained_gain = 0.0, 0.0


@kernel
def take_head(batch: Batch, i: int, now_us: int, idle: bool) -> None:
    """The socket takes the head; its bytes follow those of the message before, or begin now if the link was idle."""
    sender = batch.senders[i]
    head = batch.slots[i, sender.first]
    size_bytes = head.size_bytes
    if idle:
        reached, sender.segment_now = position_at(
            batch.knot_us,
            batch.knot_bytes,
            sender.first_knot,
            sender.last_knot,
            sender.after,
            sender.segment_now,
            now_us + sender.offset_us,
        )
        sender.position = max(reached, sender.position)
    sender.position += size_bytes
    at_us, sender.segment_finish = time_of(
        batch.knot_us,
        batch.knot_bytes,
        sender.first_knot,
        sender.last_knot,
        sender.after,
        sender.segment_finish,
        sender.position,
    )
    sender.finish_us = at_us if at_us == FOREVER else at_us - sender.offset_us
    sender.busy = 1
    sender.first += 1
    sender.occupancy -= 1
    sender.backlog_bytes -= size_bytes
    sender.taken += 1
    sender.taken_at_us = now_us
    sender.departures += 1
    fate = batch.fates[i, head.seq]
    fate.taken_us, fate.gain = now_us, head.gain


@kernel
def credit(batch: Batch, i: int, until_us: int) -> None:
    """Count the information of what reached the server by ``until_us``, propagation included."""
    sender = batch.senders[i]
    while sender.credited < sender.crossed:
        seq = batch.order[i, sender.credited]
        fate = batch.fates[i, seq]
        if until_us < fate.crossed_us + sender.propagation_us:
            break
        sender.delivered_gain += fate.gain
        sender.credited += 1


@kernel
def next_event(batch: Batch, i: int) -> int:
    """Move sender ``i`` on to its next DEPARTURE, DECISION or END (see the module's text)."""
    sender = batch.senders[i]
    while True:
        if sender.busy == 0 and sender.occupancy > 0:
            if sender.ask_at_dequeue > sender.cleared:
                return DEQUEUE
            take_head(batch, i, sender.now_us, sender.follows == 0)
            sender.cleared, sender.follows = 0, 0
            return DEPARTURE
        more = sender.next < sender.arrivals
        arrives_us = batch.arrivals[i, sender.next].arrival_us if more else FOREVER - 1
        if sender.busy == 1 and sender.finish_us <= arrives_us:
            # slots[first - 1] is the message in transmission
            seq = batch.slots[i, sender.first - 1].seq
            batch.fates[i, seq].crossed_us = sender.finish_us
            batch.order[i, sender.crossed] = seq
            sender.crossed += 1
            sender.now_us = sender.finish_us
            sender.busy = 0
            if sender.occupancy > 0:
                sender.follows = 1
            continue
        if not more:
            return END
        sender.now_us = arrives_us
        arrival = batch.arrivals[i, sender.next]
        if sender.next > 0:
            gap_us = arrives_us - sender.previous_us
            if sender.next == 1:
                sender.period_us = float(gap_us)
            sender.period_us += _PERIOD_WEIGHT * (gap_us - sender.period_us)
            sender.drain += _DRAIN_WEIGHT * (sender.departures - sender.drain)
        else:
            sender.previous_us, sender.previous_x = arrives_us, arrival.x
        asked = sender.first_decision <= sender.next <= sender.last_decision
        if asked and not (sender.ask_when_full == 1 and has_room(batch, i)):
            sender.waiting = 1
            return DECISION
        decide(batch, i, ACCEPT)


@kernel
def has_room(batch: Batch, i: int) -> bool:
    """Whether the arrival at hand fits without a drop, by messages and by bytes."""
    sender = batch.senders[i]
    size_bytes = batch.arrivals[i, sender.next].size_bytes
    return bool(sender.occupancy < sender.capacity and sender.backlog_bytes + size_bytes <= sender.max_bytes)


@kernel
def can_evict(batch: Batch, i: int, k: int) -> bool:
    """Whether evicting slot ``k`` makes the arrival at hand fit."""
    sender = batch.senders[i]
    if not 0 <= k < sender.occupancy:
        return False
    freed = batch.slots[i, sender.first + k].size_bytes
    size_bytes = batch.arrivals[i, sender.next].size_bytes
    return bool(sender.backlog_bytes - freed + size_bytes <= sender.max_bytes)


@kernel
def decide(batch: Batch, i: int, decision: int) -> bool:
    """Carry out a decision on the arrival at hand; False if it was impossible and did what a queue does instead.

    That is: accept where there is room, reject where there is none.
    """
    sender = batch.senders[i]
    arrival = batch.arrivals[i, sender.next]
    fate = batch.fates[i, sender.next]
    possible = True
    enqueue = True
    if decision >= 0 and can_evict(batch, i, decision):
        remove(batch, i, decision)
        sender.evicted += 1
    elif decision == REJECT:
        enqueue = False
    else:
        enqueue = has_room(batch, i)
        possible = decision == ACCEPT and enqueue
    if enqueue:
        # The first message of all is the 1 in H = 1 + sum of V.
        arrival.gain = 0.0
        if sender.taken > 0 or sender.occupancy > 0:
            arrival.gain = value(batch.v, arrival.x - batch.slots[i, sender.first + sender.occupancy - 1].x)
        sender.retained_gain += arrival.gain
        sender.first = push(batch.slots, i, sender.first, sender.occupancy, arrival)
        sender.occupancy += 1
        sender.backlog_bytes += arrival.size_bytes
        sender.peak_backlog_bytes = max(sender.peak_backlog_bytes, sender.backlog_bytes)
    else:
        fate.dropped_us = sender.now_us
        sender.rejected += 1
    if not possible:
        sender.impossible += 1
    sender.previous_us, sender.previous_x = arrival.arrival_us, arrival.x
    sender.departures = 0
    sender.waiting = 0
    sender.next += 1
    return possible


@kernel
def remove(batch: Batch, i: int, k: int) -> None:
    """Evict slot ``k``: its gap and its successor's become one."""
    sender = batch.senders[i]
    gone = batch.slots[i, sender.first + k]
    sender.backlog_bytes -= gone.size_bytes
    sender.retained_gain -= gone.gain
    batch.fates[i, gone.seq].dropped_us = sender.now_us
    if k + 1 < sender.occupancy:
        after = batch.slots[i, sender.first + k + 1]
        merged = value(batch.v, after.x - batch.slots[i, sender.first + k - 1].x)
        sender.retained_gain += merged - after.gain
        after.gain = merged
    sender.first = evict(batch.slots, i, sender.first, sender.occupancy, k)
    sender.occupancy -= 1


@kernel
def answer_dequeue(batch: Batch, i: int, drop: bool) -> None:
    """The policy's answer to DEQUEUE: drop the head, or let the socket take it."""
    sender = batch.senders[i]
    if not drop:
        sender.cleared = 1
        return
    remove(batch, i, 0)
    sender.evicted += 1
    if sender.occupancy == 0:
        sender.follows = 0  # nobody follows: the link goes idle


@kernel
def view(batch: Batch, i: int) -> Buffer:
    """What the policy of sender ``i`` may see now."""
    sender = batch.senders[i]
    capacity, first, occupancy = sender.capacity, sender.first, sender.occupancy
    sent = batch.slots[i, first - 1]
    taken_us, taken_x = sent.arrival_us, sent.x
    if sender.taken == 0:
        taken_us, taken_x = sender.previous_us, sender.previous_x
    left_bytes = sent.size_bytes if sender.busy == 1 else 0
    if sender.busy == 1 and sender.taken_at_us < sender.now_us:
        reached, sender.segment_now = position_at(
            batch.knot_us,
            batch.knot_bytes,
            sender.first_knot,
            sender.last_knot,
            sender.after,
            sender.segment_now,
            sender.now_us + sender.offset_us,
        )
        left_bytes = min(left_bytes, max(0, sender.position - reached))
    return Buffer(
        batch.slots[i, first : first + occupancy],
        capacity,
        sender.max_bytes,
        sender.backlog_bytes,
        sender.now_us,
        sender.taken,
        taken_us,
        taken_x,
        sender.previous_us,
        sender.previous_x,
        sender.busy,
        left_bytes,
        left_bytes / sent.size_bytes if sender.busy == 1 else 0.0,
        sender.now_us - sender.taken_at_us,
        sender.period_us,
        sender.departures,
        sender.drain,
        batch.v,
    )


@kernel
def arrival_of(batch: Batch, i: int) -> Any:
    """The arrival that waits for a decision."""
    return batch.arrivals[i, batch.senders[i].next]


# --- fixed policies --------------------------------------------------------------------------------------------------


def rollout(
    batch: Batch,
    memory: NDArray[np.float64],
    on_arrival: Any,
    on_departure: Any,
    on_dequeue: Any,
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
            elif hears_departures:
                on_departure(view(batch, i), memory[i])
            event = next_event(batch, i)
        credit(batch, i, FOREVER)


@functools.cache
def batch_type() -> Any:
    """Numba's type of a ``Batch``."""
    array, int_ = numba.types.Array, numba.types.int64
    record = {name: numba.from_dtype(dtype) for name, dtype in (("s", SENDER), ("m", MESSAGE), ("f", FATE))}
    ints = array(int_, 1, "C")
    return cast(Any, numba.types).NamedTuple(
        (
            array(record["s"], 1, "C"),
            array(record["m"], 2, "C"),
            array(record["m"], 2, "C"),
            array(record["f"], 2, "C"),
            array(int_, 2, "C"),
            ints,
            ints,
            array(numba.types.float64, 1, "C", readonly=True),
        ),
        Batch,
    )


@functools.cache
def compiled_rollout() -> Any:
    """``rollout`` compiled once for every policy (policies arrive as values of one function type)."""
    arrival, departure, dequeue = signatures()
    function = numba.types.FunctionType
    memory = numba.types.Array(numba.types.float64, 2, "C")
    return compile_for(
        numba.types.void(
            batch_type(), memory, function(arrival), function(departure), function(dequeue), numba.types.boolean
        ),
        rollout,
    )


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
    ) -> None:
        """n senders with room for L = ``capacity`` messages (and B = ``max_bytes`` bytes), without episodes yet."""
        check_limits(capacity, max_bytes)
        if decide_at not in ("arrival", "overflow"):
            raise BufgymError(f"decide_at = {decide_at!r}: must be 'arrival' or 'overflow'")
        self.capacity = int(capacity)
        self.max_bytes = UNLIMITED_BYTES if max_bytes is None else int(max_bytes)
        self.decide_at = decide_at
        self.value = v
        self.episodes: list[Episode | None] = [None] * n
        self._knots = Knots()
        self.batch = Batch(
            records(n, SENDER),
            records((n, row_width(self.capacity)), MESSAGE),
            records((n, max_messages), MESSAGE),
            records((n, max_messages), FATE),
            np.zeros((n, max_messages), np.int64),
            self._knots.us,
            self._knots.bytes,
            v.array,
        )

    def __len__(self) -> int:
        return len(self.episodes)

    def load(self, i: int, episode: Episode) -> None:
        """Begin ``episode`` at sender ``i``: empty buffer, idle socket, nothing arrived."""
        link = episode.link
        if len(episode.arrivals) > self.batch.arrivals.shape[1]:
            most = self.batch.arrivals.shape[1]
            raise BufgymError(f"episode of {len(episode.arrivals)} messages: these senders have room for {most}")
        first_knot, last_knot, after = self._knots.place(link.trace)
        if self._knots.us is not self.batch.knot_us:
            self.batch = self.batch._replace(knot_us=self._knots.us, knot_bytes=self._knots.bytes)
        self.episodes[i] = episode
        load_row(
            self.batch,
            i,
            episode.arrivals,
            (self.capacity, self.max_bytes, int(self.decide_at == "overflow")),
            (episode.first_decision, episode.last_decision),
            (first_knot, last_knot, after, link.offset_us, link.propagation_us),
        )

    def new_memory(self, policy: Policy, i: int) -> NDArray[np.float64]:
        """Fresh memory of ``policy`` for the episode of sender ``i``, float64[entries]."""
        memory: NDArray[np.float64] = policy.new_memory(1, self.capacity)[0]
        if policy.foresee is not None:
            memory = policy.foresee(self.episodes[i], self.capacity, self.max_bytes, self.value)
        return memory

    def run(self, policy: Policy, memory: NDArray[np.float64] | None = None) -> None:
        """Run every loaded sender to its end under ``policy``; ``memory``: float64[n, entries], fresh by default."""
        if memory is None:
            rows = range(len(self)) if policy.foresee is not None else ()
            memory = (
                padded([self.new_memory(policy, i) for i in rows])
                if rows
                else policy.new_memory(len(self), self.capacity)
            )
        self.batch.senders["ask_at_dequeue"] = policy.drops_at_dequeue
        if runs_compiled(policy):
            compiled_rollout()(self.batch, memory, *policy.compiled, policy.hears_departures)
        else:
            python_rollout(self.batch, memory, policy)


def padded(rows: Sequence[NDArray[Any]]) -> NDArray[np.float64]:
    """Rows of different lengths as one array, filled up with zeros."""
    made = np.zeros((len(rows), max(map(len, rows))))
    for i, row in enumerate(rows):
        made[i, : len(row)] = row
    return made


def named(batch: Batch) -> Batch:
    """The same memory, as records whose fields read as attributes in plain Python too."""
    return Batch(*(cast(Any, a.view(np.recarray) if a.dtype.names else a) for a in batch))


python_view = getattr(view, "py_func", view)
"""``view`` for Python callers, over a ``named`` batch: the compiled kernel must not hand its arrays to Python."""


def python_rollout(batch: Batch, memory: NDArray[np.float64], policy: Policy) -> None:
    """``rollout`` for a policy that is ordinary Python: the transition stays compiled, views are made in Python."""
    seen = named(batch)
    for i in range(len(batch.senders)):
        event = next_event(batch, i)
        while event != END:
            if event == DECISION:
                arrival = seen.arrivals[i, seen.senders[i].next]
                decide(batch, i, int(policy.on_arrival(python_view(seen, i), arrival, memory[i])))
            elif event == DEQUEUE:
                answer_dequeue(batch, i, bool(policy.on_dequeue(python_view(seen, i), memory[i])))
            elif policy.hears_departures:
                policy.on_departure(python_view(seen, i), memory[i])
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
) -> Senders:
    """The senders after ``policy`` met each of ``episodes``, one sender each; an unbounded policy has L = all."""
    if not episodes:
        raise BufgymError("no episode to run")
    longest = max(len(episode.arrivals) for episode in episodes)
    capacity = longest if policy.unbounded else capacity
    senders = Senders(len(episodes), capacity, v, max_messages=longest, max_bytes=max_bytes, decide_at=decide_at)
    for i, episode in enumerate(episodes):
        senders.load(i, episode)
    senders.run(policy, memory)
    return senders
