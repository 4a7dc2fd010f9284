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

from bufgym.sim.metrics import Outcome, outcome
from bufgym.sim.senders import Senders, run
from bufgym.sim.state import NEVER

__all__ = ["Outcome", "outcome", "run"]
