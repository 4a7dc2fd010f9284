"""The main loop for a fixed policy: compiled once for all compiled policies, or with a policy in ordinary Python.

Both run senders with links of their own (``shares`` is None) and robots that share the link of a cell.
"""

import functools
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import JIT, interruptible, kernel, named
from bufgym.model.buffer import Buffer
from bufgym.model.link import FOREVER
from bufgym.policies.registry import Policy
from bufgym.sim.decisions import answer_dequeue, answer_send, decide
from bufgym.sim.shared_link import Shares
from bufgym.sim.socket import credit
from bufgym.sim.state import ARRIVAL_WAITS, DECISION, DEPARTURE, DEQUEUE, END, NOTHING, SEND, Batch
from bufgym.sim.transition import move_on, next_event, sender_of
from bufgym.sim.view import arrival_of, view
from bufgym.utils.errors import BufgymError

_SHORT = 200_000  # Arrivals times numbers read at each, for a rollout that takes at most some milliseconds


@kernel
def ask(
    batch: Batch,
    i: int,
    event: int,
    memory: NDArray[np.float64],
    on_arrival: Any,
    on_departure: Any,
    on_dequeue: Any,
    on_send: Any,
) -> None:
    """Let the policy of sender ``i`` answer ``event``, or hear of a departure; ``memory`` is this sender's."""
    buffer = view(batch, i)
    if event == DECISION:
        decide(batch, i, on_arrival(buffer, arrival_of(batch, i), memory))
    elif event == DEQUEUE:
        answer_dequeue(batch, i, on_dequeue(buffer, memory))
    elif event == SEND:
        answer_send(batch, i, on_send(buffer, memory))
    else:
        on_departure(buffer, memory)


@kernel
def rollout(
    batch: Batch,
    shares: Shares | None,
    memory: NDArray[np.float64],
    on_arrival: Any,
    on_departure: Any,
    on_dequeue: Any,
    on_send: Any,
    hears_departures: bool,
) -> None:
    """Run every sender of the batch to its end under one policy; ``memory`` is float64[n, entries]."""
    for c in range(len(batch.senders) if shares is None else len(shares.cells)):
        event, again = NOTHING, False
        while event != END:
            if not again:
                event = move_on(batch, shares, c)
            again = False
            # One view for all events: the kernels are inlined, so the loop's code stays small.
            if event == END or (event == DEPARTURE and not hears_departures):
                continue
            i = sender_of(shares, c)
            ask(batch, i, event, memory[i], on_arrival, on_departure, on_dequeue, on_send)
            # B has no room yet: the same DECISION is due again
            again = event == DECISION and batch.senders[i].waiting == ARRIVAL_WAITS
    # What the link carried arrives, though it be after the last event: TCP loses nothing.
    for i in range(len(batch.senders)):
        credit(batch, i, FOREVER)


# In plain Python a view keeps its arrays alive; the kernel counts no references.
_view = getattr(view, "py_func", view)


@functools.cache
def own_rollout(functions: Any, hears_departures: bool) -> Any:
    """``rollout`` with a link each for one policy, of ``compiled`` functions: quicker, but a second to compile."""
    on_arrival, on_departure, on_dequeue, on_send = (function.py_func for function in functions)

    @kernel
    def rollout_of(batch: Batch, memory: NDArray[np.float64]) -> None:
        rollout(batch, None, memory, on_arrival, on_departure, on_dequeue, on_send, hears_departures)

    return rollout_of


def python_view(batch: Batch, i: int) -> Buffer:
    """Make a ``view`` for Python over a ``named`` batch: the compiled kernel must not hand its arrays to Python.

    It is read-only.
    """
    buffer: Buffer = _view(batch, i)
    buffer.slots.flags.writeable = False
    buffer.topics.flags.writeable = False
    buffer.past.flags.writeable = False
    return buffer


def python_arrival(batch: Batch, i: int, before: int = 0) -> Any:
    """The arrival that waits for a decision, read-only, for Python over a ``named`` batch.

    ``before`` picks an earlier arrival: the one so many before it.
    """
    row = batch.arrivals[i]
    row.flags.writeable = False
    return row[batch.senders[i].next - before]


def answer_of(policy: Policy, hook: str, answer: Any) -> int:
    """Convert the answer of a policy in Python to a whole number (or a yes or no); BufgymError for anything else."""
    try:
        number = int(answer)
    except (TypeError, ValueError, OverflowError):
        number = None
    if number is None or number != answer:
        raise BufgymError(f"policy {policy.name}: {hook} returned {answer!r}: must be a whole number")
    return number


def python_rollout(batch: Batch, shares: Shares | None, memory: NDArray[np.float64], policy: Policy) -> None:
    """Run a policy in ordinary Python: the transition stays compiled, views are made in Python."""
    records = named(batch)
    for c in range(len(batch.senders) if shares is None else len(shares.cells)):
        while (event := next_event(batch, shares, c)) != END:
            i = sender_of(shares, c)
            if event == DEPARTURE and not policy.hears_departures:
                continue
            buffer = python_view(records, i)
            if event == DECISION:
                answer = policy.on_arrival(buffer, python_arrival(records, i), memory[i])
                decide(batch, i, answer_of(policy, "on_arrival", answer))
            elif event == DEQUEUE:
                answer_dequeue(batch, i, bool(answer_of(policy, "on_dequeue", policy.on_dequeue(buffer, memory[i]))))
            elif event == SEND:
                answer_send(batch, i, answer_of(policy, "on_send", policy.on_send(buffer, memory[i])))
            else:
                policy.on_departure(buffer, memory[i])
    for i in range(len(batch.senders)):
        credit(batch, i, FOREVER)


_PAYS_IF_READY_S, _PAYS_S = 0.05, 2.0  # time in the shared rollout that earns a policy its own: if made already; always
_spent_s: dict[Any, float] = {}


def choose_own(policy: Policy, spent_s: float, *arguments: Any) -> Any:
    """The policy's own rollout, if it pays after so many seconds in the one for all; else None."""
    # Compiling takes seconds, so a policy must have spent about as long; loading takes milliseconds.
    if not JIT or spent_s <= _PAYS_IF_READY_S or getattr(policy.compiled[0], "address", None) is None:
        return None
    own = own_rollout(policy.compiled, policy.hears_departures)
    return own if own.code(arguments, ready=spent_s < _PAYS_S) else None


def roll_out(batch: Batch, shares: Shares | None, memory: NDArray[np.float64], policy: Policy) -> None:
    """Run every sender to its end under ``policy``, compiled if the policy is."""
    if not policy.compile:
        python_rollout(batch, shares, memory, policy)
        return
    spent_s = _spent_s.get(policy.compiled, 0.0)
    own = choose_own(policy, spent_s, batch, memory) if shares is None else None
    compiled: Any = own or rollout
    arguments = (batch, memory) if own else (batch, shares, memory, *policy.compiled, policy.hears_departures)
    began_s = perf_counter()
    # Its work at each arrival grows with its memory and the numbers it reads.
    if batch.senders["arrivals"].sum() * (memory.shape[1] + len(batch.parameters)) < _SHORT:
        compiled(*arguments)
    else:
        interruptible(lambda: compiled(*arguments))
    if not own:
        _spent_s[policy.compiled] = spent_s + perf_counter() - began_s
