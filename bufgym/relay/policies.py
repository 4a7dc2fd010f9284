"""How a subscriber's queue decides: any of the relay's policies by name, and what Robofleet's server does."""

from __future__ import annotations

import functools
from typing import Final

from bufgym.live import PolicyQueue
from bufgym.model.buffer import ACCEPT, REJECT, Buffer
from bufgym.model.topics import Topic
from bufgym.policies import registry
from bufgym.policies.registry import Arrival, Memory, Policy

PLACES: Final = 32
"""Topics that share a queue, where the policy knows topics."""
ROOM: Final = 64
"""Messages between two tidyings of a queue's bookkeeping: little, as there are many queues."""


def skip_pending(buffer: Buffer, arrival: Arrival, memory: Memory) -> int:
    """A receiver that has bytes pending is skipped: nothing is queued (Robofleet's server)."""
    return REJECT if buffer.busy else ACCEPT


SKIP_PENDING: Final = Policy(
    "skip-pending", skip_pending, source="Robofleet's server (ut-amrl/robofleet_server)", compile=True
)


def policy(name: str) -> Policy:
    """The policy of this name, with settings as ``decimate:every=2``."""
    return SKIP_PENDING if name == SKIP_PENDING.name else registry.get(name)


def new_queue(chosen: Policy, capacity: int) -> PolicyQueue:
    """A queue for the messages of up to ``PLACES`` topics, or of one for a policy that knows none."""
    topics = tuple(Topic(f"/{k}") for k in range(PLACES)) if chosen.for_topics else ()
    return PolicyQueue(chosen, capacity, topics=topics, room=ROOM)


@functools.lru_cache(256)
def warm(name: str) -> Policy:
    """The policy, after one message has gone through a queue of it: now it is compiled."""
    return compiled(policy(name))


def compiled(chosen: Policy) -> Policy:
    """The same for one that has no name here."""
    queue = new_queue(chosen, PLACES)
    queue.put(b"", 1)
    queue.get(0)
    queue.gone()
    return queue.policy
