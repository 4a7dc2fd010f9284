"""What a batch of senders consists of: arrays that the caller owns and the kernels change in place."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple, cast

import numba
import numpy as np
from numpy.typing import NDArray

from bufgym.model.buffer import MESSAGE, NO_PARAMETERS, TOPIC

END, DEPARTURE, DECISION, DEQUEUE, SEND = range(5)
ARRIVAL_WAITS, SOCKET_WAITS = 1, 2
"""What a sender may be ``waiting`` for: a decision on its arrival, or the choice of what to send."""

SENDER = np.dtype(
    [
        # what the sender is
        ("capacity", np.int64),  # L, messages
        ("max_bytes", np.int64),  # B, bytes
        ("ask_when_full", np.int64),  # 1: only an arrival that finds no room asks for a decision
        ("ask_at_dequeue", np.int64),  # 1: the policy may drop the head before the socket takes it
        ("ask_at_send", np.int64),  # 1: a scheduler chooses which message the free socket takes
        ("topics", np.int64),  # 1: one queue, whatever the messages' topics; else each topic has rules of its own
        ("window", np.int64),  # n_T: messages sent and not yet answered by a pong, at most
        ("ack_delay_us", np.int64),  # from a message's crossing to its pong
        ("limit_at_send", np.int64),  # 1: rate limits hold back at the socket, 0: they drop at arrival
        ("flush_no_drop", np.int64),  # 1: no_drop messages are sent even when the window is full
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
        ("busy", np.int64),  # messages that it took and that have not crossed yet
        ("cleared", np.int64),  # 1: the head may go; nobody need be asked again
        ("follows", np.int64),  # 1: the head follows the message before it without a pause
        ("chosen", np.int64),  # the slot that the scheduler sends next, NEVER before it is asked
        ("held", np.int64),  # 1: the scheduler sends nothing before the next arrival or pong
        ("acked", np.int64),  # messages answered by a pong
        ("position", np.int64),  # bytes of the trace used up when all that the socket took has crossed
        ("finish_us", np.int64),  # when the message in transmission will have crossed
        ("segment_now", np.int64),  # where on the trace the clock and the socket were last looked up
        ("segment_finish", np.int64),
        # counts
        ("dequeued", np.int64),  # messages the socket took
        ("transmitted", np.int64),  # messages that left the socket
        ("credited", np.int64),  # messages that reached the server
        ("rejected", np.int64),
        ("evicted", np.int64),
        ("invalid", np.int64),  # decisions that could not be carried out as given
        ("peak_backlog_bytes", np.int64),  # queued at most
        # what the policy may know of its own past
        ("previous_us", np.int64),
        ("previous_x", np.float64),
        ("last_dequeue_us", np.int64),  # when the socket last took a message
        ("departures", np.int64),
        ("period_us", np.float64),
        ("service_ratio", np.float64),
        # information
        ("delivered_gain", np.float64),  # sum of V over what reached the server
        ("retained_gain", np.float64),  # sum of V over what is kept or sent
        ("aged", np.float64),  # weight x age of information at the server, integrated over time, s^2
        ("late", np.float64),  # sum of weights of messages that came later than their deadline
    ],
    align=True,
)

LOG_ENTRY = np.dtype(
    [
        ("dequeued_us", np.int64),  # the socket took it out of the buffer
        ("due_us", np.int64),  # its last byte will cross the link; known once the socket has it
        ("transmitted_us", np.int64),  # its last byte crossed the link
        ("dropped_us", np.int64),  # it was evicted or rejected
        ("limited", np.int64),  # 1: a rate limit dropped it
        ("gain", np.float64),  # V that its delivery adds; it is settled once the socket has taken it
    ],
    align=True,
)
NEVER = -1
"""In FATE: it did not happen."""


class Batch(NamedTuple):
    """The arrays of n senders, changed in place by the kernels. A snapshot is a copy of them."""

    senders: NDArray[Any]
    """SENDER[n]"""
    slots: NDArray[Any]
    """MESSAGE[n, 1 + 2 L] (see ``bufgym.model.buffer``)"""
    arrivals: NDArray[Any]
    """MESSAGE[n, messages]"""
    log: NDArray[Any]
    """FATE[n, messages]"""
    order: NDArray[np.int64]
    """[n, messages]: sequence numbers in the order in which the socket took them."""
    knot_us: NDArray[np.int64]
    knot_bytes: NDArray[np.int64]
    v: NDArray[np.float64]
    topics: NDArray[Any]
    """TOPIC[n, topics]"""
    parameters: NDArray[np.float64] = NO_PARAMETERS
    """float64[parameters], read-only: those of the policy at hand, which ``view`` shows it."""


@functools.cache
def batch_type() -> Any:
    """Numba's type of a ``Batch``."""
    array, int_ = numba.types.Array, numba.types.int64
    record = {
        name: numba.from_dtype(dtype) for name, dtype in (("s", SENDER), ("m", MESSAGE), ("f", LOG_ENTRY), ("t", TOPIC))
    }
    ints, constants = array(int_, 1, "C"), array(numba.types.float64, 1, "C", readonly=True)
    return cast(Any, numba.types).NamedTuple(
        (
            array(record["s"], 1, "C"),
            array(record["m"], 2, "C"),
            array(record["m"], 2, "C"),
            array(record["f"], 2, "C"),
            array(int_, 2, "C"),
            ints,
            ints,
            constants,
            array(record["t"], 2, "C"),
            constants,
        ),
        Batch,
    )


def named(batch: Batch) -> Batch:
    """The same memory, as records whose fields read as attributes in plain Python too."""
    return Batch(*(cast(Any, a.view(np.recarray) if a.dtype.names else a) for a in batch))
