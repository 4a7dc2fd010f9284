"""The main loop for a fixed policy: compiled once for all compiled policies, or with a policy in ordinary Python.

Both run senders with links of their own (``shares`` is None) and robots that share the link of a cell.
"""

import functools
from contextlib import nullcontext, suppress
from time import perf_counter
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import JIT, NotCachedError, cached_only, compile_signature, interruptible, kernel, named
from bufgym.model.buffer import Buffer
from bufgym.model.link import FOREVER
from bufgym.policies.registry import Policy, signatures
from bufgym.sim.decisions import answer_dequeue, answer_send, decide
from bufgym.sim.shared_link import Shares, shares_type
from bufgym.sim.socket import credit
from bufgym.sim.state import ARRIVAL_WAITS, DECISION, DEPARTURE, DEQUEUE, END, NOTHING, SEND, Batch, batch_type
from bufgym.sim.transition import move_on, next_event, sender_of
from bufgym.sim.view import arrival_of, view
from bufgym.utils.errors import BufgymError

if JIT:
    import numba

_SHORT = 200_000  # Arrivals times numbers read at each, for a rollout that takes at most some milliseconds


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
            buffer = view(batch, i)
            if event == DECISION:
                decide(batch, i, on_arrival(buffer, arrival_of(batch, i), memory[i]))
                again = batch.senders[i].waiting == ARRIVAL_WAITS  # B has no room yet: the same DECISION is due again
            elif event == DEQUEUE:
                answer_dequeue(batch, i, on_dequeue(buffer, memory[i]))
            elif event == SEND:
                answer_send(batch, i, on_send(buffer, memory[i]))
            else:
                on_departure(buffer, memory[i])
    # What the link carried arrives, though it be after the last event: TCP loses nothing.
    for i in range(len(batch.senders)):
        credit(batch, i, FOREVER)


@functools.cache
def compiled_rollout(shared: bool, several: bool) -> Any:
    """``rollout`` compiled once for every policy, as policies arrive as values of one function type.

    ``shared``: the cells of a shared link, or senders with a link each. ``several``: several topics, or one queue.
    """
    if not JIT:
        return rollout
    functions = tuple(numba.types.FunctionType(signature) for signature in signatures())
    memory = numba.types.Array(numba.types.float64, 2, "C")
    shares = shares_type() if shared else numba.types.none
    return compile_signature(
        numba.types.void(batch_type(several), shares, memory, *functions, numba.types.boolean), rollout
    )


# In plain Python a view keeps its arrays alive; the kernel counts no references.
_view = getattr(view, "py_func", view)
_inlined: Any = kernel(rollout)


@functools.cache
def own_rollout(functions: Any, hears_departures: bool) -> Any:
    """``rollout`` with a link each for one policy, of ``compiled`` functions: half the time, but seconds to compile."""
    on_arrival, on_departure, on_dequeue, on_send = (kernel(function.py_func) for function in functions)

    def rollout_of(batch: Batch, memory: NDArray[np.float64]) -> None:
        _inlined(batch, None, memory, on_arrival, on_departure, on_dequeue, on_send, hears_departures)

    rollout_of.__qualname__ = f"rollout_of_{functions[0].__qualname__}"  # it names the file of its code
    return kernel(rollout_of)


def python_view(batch: Batch, i: int) -> Buffer:
    """Make a ``view`` for Python over a ``named`` batch: the compiled kernel must not hand its arrays to Python.

    It is read-only.
    """
    buffer: Buffer = _view(batch, i)
    buffer.slots.flags.writeable = False
    buffer.topics.flags.writeable = False
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


_PAYS_IF_CACHED_S, _PAYS_S = 0.05, 2.0  # time in the shared rollout that earns a policy its own: if cached; always
_spent_s: dict[Any, float] = {}


def choose_own(policy: Policy, spent_s: float, several: bool, memory: NDArray[np.float64]) -> Any:
    """The policy's own rollout, if it pays after so many seconds in the one for all; else None."""
    # Compiling takes seconds, so a policy must have spent about as long; loading takes milliseconds.
    if not JIT or spent_s <= _PAYS_IF_CACHED_S:
        return None
    with suppress(NotCachedError), cached_only() if spent_s < _PAYS_S else nullcontext():
        kinds = batch_type(several), cast(Any, numba).typeof(memory)
        return own_rollout(policy.compiled, policy.hears_departures).compile(kinds)
    return None


def roll_out(batch: Batch, shares: Shares | None, memory: NDArray[np.float64], policy: Policy) -> None:
    """Run every sender to its end under ``policy``, compiled if the policy is."""
    if not policy.compile:
        python_rollout(batch, shares, memory, policy)
        return
    several, spent_s = bool(batch.several), _spent_s.get(policy.compiled, 0.0)
    own = choose_own(policy, spent_s, several, memory) if shares is None else None
    compiled = own or compiled_rollout(shares is not None, several)
    arguments = (batch, memory) if own else (batch, shares, memory, *policy.compiled, policy.hears_departures)
    began_s = perf_counter()
    # Its work at each arrival grows with its memory and the numbers it reads.
    if batch.senders["arrivals"].sum() * (memory.shape[1] + len(batch.parameters)) < _SHORT:
        compiled(*arguments)
    else:
        interruptible(lambda: compiled(*arguments))
    if not own:
        _spent_s[policy.compiled] = spent_s + perf_counter() - began_s
