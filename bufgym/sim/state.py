"""Arrays of a batch of senders, which the caller owns and the kernels change in place."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bufgym.jit import kernel, records
from bufgym.model.buffer import MESSAGE, NO_PARAMETERS, TOPIC, row_width
from bufgym.model.documented import documented
from bufgym.model.link import FOREVER
from bufgym.model.past import PAST

END, DEPARTURE, DECISION, DEQUEUE, SEND = range(5)
"""Events of a sender (see the package's text)."""
NOTHING = -1  # No event: time moves on without a question or a departure

NOTHING_WAITS, ARRIVAL_WAITS, SOCKET_WAITS = range(3)
"""What a sender may be ``waiting`` for: nothing, a decision on its arrival, or the choice of a message to send."""

UNASKED, CLEARED, CHOSEN, HELD = range(4)
"""States of a sender's ``socket``. UNASKED: its next message is undecided. CLEARED: the policy does not drop the head.
CHOSEN: it dequeues slot ``chosen``. HELD: it dequeues nothing before the next arrival or ack."""

IDLE, FREED, CARRIES = range(3)
"""States of a sender's ``link``. IDLE: nothing to carry. FREED: it has just finished a message, so the next one follows
without a pause. CARRIES: a message is in transmission."""

SENDER = np.dtype(
    [
        # settings
        ("capacity", np.int64),  # L, messages
        ("max_bytes", np.int64),  # B, bytes
        ("ask_when_full", np.int64),  # 1: only an arrival that finds no room asks for a decision
        ("screens", np.int64),  # 1: an arrival may ask for no decision, or for several: ask_when_full, or a limit B
        ("ask_at_dequeue", np.int64),  # 1: the policy may drop the head before the socket dequeues it
        ("measures", np.int64),  # 1: the link's rate is measured at each arrival; 0: nobody reads it
        ("remembers", np.int64),  # 1: the past of link and camera is kept, of what is measured; 0: nobody reads it
        ("shows_left", np.int64),  # 1: the bytes left in the socket are shown; 0: nobody reads them
        ("ask_at_send", np.int64),  # 1: a scheduler chooses which message the socket dequeues
        ("topics", np.int64),  # 1: one queue, whatever the messages' topics; else each topic has rules of its own
        ("weight", np.float64),  # sum of the weights of all topics; 1 if that is 0, as it divides
        ("limit_at_send", np.int64),  # 1: rate limits hold back at the socket, 0: they drop at arrival
        ("limit_since_sent", np.int64),  # 1: at arrival they count from the message sent last, 0: kept last
        ("flush_no_drop", np.int64),  # 1: no_drop messages are sent even when the window is full
        # episode, as ``Episode.words`` has it
        ("arrivals", np.int64),  # messages in all
        ("first_decision", np.int64),  # arrivals from this one to
        ("last_decision", np.int64),  # this one ask for a decision
        ("window", np.int64),  # n_T: most messages sent and not yet acked
        ("ack_delay_us", np.int64),  # from the end of a message's transmission to its ack
        ("ends_us", np.int64),  # when the stream ends, as far as it was told; FOREVER if it was not
        ("offset_us", np.int64),
        ("propagation_us", np.int64),
        ("v_start", np.int64),  # for one queue: where its V begins in the array of all V
        # its place in the batch's knots
        ("first_knot", np.int64),  # first knot of its trace
        ("last_knot", np.int64),
        ("after", np.int64),  # what follows the trace's end: LOOP, HOLD or STOP
        ("segment_now", np.int64),  # where on the trace the clock and the socket were last looked up
        ("segment_finish", np.int64),
        # what a live row has forgotten; 0 elsewhere
        ("first_seq", np.int64),  # ``seq`` in the first column
        ("forgotten", np.int64),  # messages dequeued before those in ``order``
        # clock
        ("now_us", np.int64),
        ("next", np.int64),  # the next arrival, or the one that waits for a decision
        ("waiting", np.int64),  # NOTHING_WAITS, ARRIVAL_WAITS or SOCKET_WAITS
        ("evictions", np.int64),  # messages evicted for that arrival so far
        # buffer
        ("first", np.int64),  # column of the head
        ("occupancy", np.int64),
        ("backlog_bytes", np.int64),
        # socket
        ("socket", np.int64),  # UNASKED, CLEARED, CHOSEN or HELD
        ("chosen", np.int64),  # the slot that it dequeues next; 0 unless CHOSEN
        ("busy", np.int64),  # messages dequeued and not yet transmitted
        ("acked", np.int64),  # messages acked
        # link
        ("link", np.int64),  # IDLE, FREED or CARRIES
        ("position", np.int64),  # bytes of the trace used up when the message in transmission has been transmitted
        ("finish_us", np.int64),  # time of this end; FOREVER while the link is idle
        ("began_us", np.int64),  # when the link began with the message in transmission
        ("carried_us", np.int64),  # time that the link took for all messages before it
        # counts
        ("dequeued", np.int64),  # messages the socket dequeued
        ("dequeued_bytes", np.int64),
        ("transmitted", np.int64),  # messages whose last byte has crossed the link
        ("credited", np.int64),  # messages that reached the server
        ("rejected", np.int64),
        ("evicted", np.int64),
        ("invalid", np.int64),  # decisions that could not be carried out as given
        ("peak_backlog_bytes", np.int64),  # largest backlog so far
        # what the policy may know of the past
        ("previous_us", np.int64),  # time of the previous arrival
        ("previous_x", np.float64),
        ("last_dequeue_us", np.int64),  # when the socket last dequeued a message
        ("departures", np.int64),  # messages dequeued since the previous arrival
        ("period_us", np.float64),  # running mean of the time between arrivals
        ("arrival_bytes", np.float64),  # running mean of the bytes of an arrival
        ("service_ratio", np.float64),  # running mean of departures per arrival
        ("left_bytes", np.int64),  # in the socket when the present arrival came
        ("sent_bytes", np.int64),  # bytes that had left the socket by then
        ("sending_us", np.int64),  # time that the link had carried this sender's bytes by then
        ("drained_bytes", np.int64),  # the parts of both since the previous arrival
        ("drained_us", np.int64),
        ("short_rate", np.float64),  # running means of the link's rate while it carries, bytes/us
        ("medium_rate", np.float64),
        ("long_rate", np.float64),
        # information
        ("delivered_gain", np.float64),  # sum of V over what reached the server
        ("retained_gain", np.float64),  # sum of V over what is kept or sent
        ("aged", np.float64),  # weight x age of information at the server, integrated over time, s^2
        ("aged_us", np.int64),  # time up to which this has been counted
        ("ageing", np.float64),  # sum of the weights of topics with an arrival: their age counts
        ("newest_s", np.float64),  # sum of weight x arrival time of the topic's newest message at the server, s
        ("heard", np.float64),  # sum of the weights of topics with a message at the server
        ("late", np.float64),  # sum of weights of messages that came later than their deadline
    ],
    align=True,
)

LOG_ENTRY = np.dtype(
    [
        ("dequeued_us", np.int64),  # the socket took it out of the buffer
        ("transmitted_us", np.int64),  # its last byte crossed the link
        ("dropped_us", np.int64),  # it was evicted or rejected
        ("limited", np.int64),  # 1: a rate limit dropped it
        ("gain", np.float64),  # V that its delivery adds; settled once the socket has dequeued it
    ],
    align=True,
)
NEVER = -1
"""A time in LOG_ENTRY for an event that has not happened."""

NOT_YET = FOREVER - 1  # Arrival time of a message that a live row still waits for: the row stops there


@documented
class Batch(NamedTuple):
    """The arrays of n senders, changed in place by the kernels. A snapshot is a copy of them."""

    senders: NDArray[Any]
    """SENDER[n]: settings, state and counts of each sender."""
    slots: NDArray[Any]
    """MESSAGE[n, 1 + 2 L]: the message dequeued last and the queued ones (see ``bufgym.model.buffer``)."""
    arrivals: NDArray[Any]
    """MESSAGE[n, messages]: the episode, in order of arrival."""
    log: NDArray[Any]
    """LOG_ENTRY[n, messages]: the fate of each message that has arrived."""
    order: NDArray[np.int64]
    """int64[n, messages]: sequence numbers in the order in which the socket dequeued them."""
    knot_us: NDArray[np.int64]
    """int64[knots]: times of the knots of every trace, us (see ``bufgym.model.link.KnotStore``)."""
    knot_bytes: NDArray[np.int64]
    """int64[knots]: bytes that the trace has carried by then."""
    v: NDArray[np.float64]
    """float64[entries]: the value functions, one after the other (``Value.array``)."""
    topics: NDArray[Any]
    """TOPIC[n, topics]: the rules and the past of each topic; one row for a single queue."""
    past: NDArray[np.float64]
    """float64[n, PAST]: what each sender remembers of its link and its camera."""
    parameters: NDArray[np.float64] = NO_PARAMETERS
    """float64[parameters], read-only: parameters of the present policy, as ``view`` shows them."""
    several: bool | None = None
    """True for several topics; None for one queue, whose kernels know no topics."""


def new_batch(n: int, capacity: int, messages: int, topics: int, v: NDArray[np.float64]) -> Batch:
    """Make arrays for n senders with L = ``capacity`` and at most ``messages`` arriving messages; no traces yet."""
    slots, rules, several = records((n, row_width(capacity)), MESSAGE), records((n, topics), TOPIC), topics > 1 or None
    arrivals, log = records((n, messages), MESSAGE), records((n, messages), LOG_ENTRY)
    order, past = np.zeros((n, messages), np.int64), np.zeros((n, PAST))
    knot_us, knot_bytes = np.zeros(0, np.int64), np.zeros(0, np.int64)
    return Batch(records(n, SENDER), slots, arrivals, log, order, knot_us, knot_bytes, v, rules, past, several=several)


@kernel
def place_of(batch: Batch, i: int, message: Any) -> int:
    """Index of ``message`` in the log: its ``seq``, kept in range whatever a compiled policy wrote there."""
    return int(max(0, min(message.seq - batch.senders[i].first_seq, batch.senders[i].arrivals - 1)))


def beginning(**settings: float) -> NDArray[np.int64]:
    """int64[fields]: SENDER at the beginning of an episode, as whole words: empty buffer, idle socket, nothing arrived.

    NumPy copies records field by field; it copies words five times as fast.
    """
    record = np.zeros(1, SENDER)
    for name, number in {
        "first": 1,
        "finish_us": FOREVER,
        "measures": 1,
        "remembers": 1,
        "shows_left": 1,
        **settings,
    }.items():
        record[name] = number
    return record.view(np.int64)
