"""The sender: one transition function for a batch of senders, and the main loop for a fixed policy.

At an arrival at time t: (1) every message that the link has finished by t leaves, and the next ones begin; (2) the
policy decides; (3) if the socket is idle it dequeues the head at once. After the last arrival the buffer empties.
Transport is TCP, so nothing sent is lost. The message in transmission is outside the buffer.

``next_event`` moves one sender on to its next event. DEPARTURE: the socket dequeued a message. DECISION: an arrival
asks for a decision. END: the episode is over. ``decide`` carries a decision out. Under a byte limit B one eviction may
not make room. The same DECISION then comes again, with the present queue, until the arrival fits or is rejected. An
arrival larger than B is dropped unasked. Environments, rollouts and benchmarks are loops around these two. Queue
disciplines that drop at the head, such as CoDel, are asked before the socket dequeues it (DEQUEUE, ``answer_dequeue``).
A scheduler chooses the message that the socket dequeues (SEND, ``answer_send``).

The socket dequeues while fewer than n_T messages are in flight, sent and not yet acked. The ack comes a round trip
after a message's last byte has crossed the link. With n_T = 1 and no ack delay the socket is free whenever the link is.

Robots that share the link of a cell are senders like all others: only the link differs (``bufgym.sim.shared_link``).
"""

from bufgym.sim.decisions import (
    answer_dequeue,
    answer_send,
    can_evict,
    can_hold,
    can_reject,
    can_send,
    decide,
    has_room,
)
from bufgym.sim.rollout import answer_of, python_arrival, python_view
from bufgym.sim.rules import age_until
from bufgym.sim.senders import Senders, padded, run
from bufgym.sim.socket import credit
from bufgym.sim.state import (
    ARRIVAL_WAITS,
    DECISION,
    DEPARTURE,
    DEQUEUE,
    END,
    NEVER,
    NOTHING_WAITS,
    SEND,
    SOCKET_WAITS,
    Batch,
)
from bufgym.sim.transition import next_event, offer
from bufgym.sim.view import arrival_of, view

__all__ = [
    "ARRIVAL_WAITS",
    "DECISION",
    "DEPARTURE",
    "DEQUEUE",
    "END",
    "NEVER",
    "NOTHING_WAITS",
    "SEND",
    "SOCKET_WAITS",
    "Batch",
    "Senders",
    "age_until",
    "answer_dequeue",
    "answer_of",
    "answer_send",
    "arrival_of",
    "can_evict",
    "can_hold",
    "can_reject",
    "can_send",
    "credit",
    "decide",
    "has_room",
    "next_event",
    "offer",
    "padded",
    "python_arrival",
    "python_view",
    "run",
    "view",
]
