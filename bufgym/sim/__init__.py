"""The sender: one transition function for a batch of senders, and the main loop for a fixed policy.

Order of things at an arrival at time t: (1) everything the link finishes up to and including t leaves, and successors
start; (2) the policy decides; (3) if the socket is idle it takes the head at once. After the last arrival the buffer
drains. Nothing sent is lost (TCP); the message in transmission is outside the buffer.

``next_event`` moves one sender to the next thing that somebody must hear of: the socket took a message (DEPARTURE), an
arrival asks for a decision (DECISION), or it is over (END). ``decide`` carries a decision out. Environments, rollouts
and benchmarks are loops around these two. Queue disciplines that drop at the head, such as CoDel, are asked there too
(DEQUEUE, ``answer_dequeue``), and a scheduler chooses what the free socket takes (SEND, ``answer_send``).

The socket takes a message while fewer than n_T are in flight: sent and not yet answered by a pong, which comes a round
trip after the last byte has crossed. With n_T = 1 and no delay that is a socket that is free as soon as the link is.
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
from bufgym.sim.rules import age_until
from bufgym.sim.senders import (
    Senders,
    answer_of,
    ask,
    compiled_rollout,
    padded,
    python_rollout,
    python_view,
    rollout,
    run,
)
from bufgym.sim.socket import begin_transmission, credit, dequeue, finish_transmission, may_dequeue
from bufgym.sim.state import (
    ARRIVAL_WAITS,
    DECISION,
    DEPARTURE,
    DEQUEUE,
    END,
    LOG_ENTRY,
    NEVER,
    SEND,
    SENDER,
    SOCKET_WAITS,
    Batch,
    batch_type,
    named,
)
from bufgym.sim.transition import arrive, next_event
from bufgym.sim.view import arrival_of, view

__all__ = [
    "ARRIVAL_WAITS",
    "DECISION",
    "DEPARTURE",
    "DEQUEUE",
    "END",
    "LOG_ENTRY",
    "NEVER",
    "SEND",
    "SENDER",
    "SOCKET_WAITS",
    "Batch",
    "Senders",
    "age_until",
    "answer_dequeue",
    "answer_of",
    "answer_send",
    "arrival_of",
    "arrive",
    "ask",
    "batch_type",
    "begin_transmission",
    "can_evict",
    "can_hold",
    "can_reject",
    "can_send",
    "compiled_rollout",
    "credit",
    "decide",
    "dequeue",
    "finish_transmission",
    "has_room",
    "may_dequeue",
    "named",
    "next_event",
    "padded",
    "python_rollout",
    "python_view",
    "rollout",
    "run",
    "view",
]
