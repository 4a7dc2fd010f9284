"""How a subscriber's queue decides: any of the relay's policies by name, and what Robofleet's server does.

A relay listens before it knows any: what compiles is imported where it is used, first by ``warm`` in a thread.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from bufgym.live import PolicyQueue
    from bufgym.policies.registry import Policy

SKIP_PENDING: Final = "skip-pending"
PLACES: Final = 32
"""Topics that share a queue, where the policy knows topics."""
ROOM: Final = 64
"""Messages between two tidyings of a queue's bookkeeping: little, as there are many queues."""


def policy(name: str) -> Policy:
    """The policy of this name, with settings as ``decimate:every=2``."""
    from bufgym.policies import registry
    from bufgym.relay import skip_pending

    return skip_pending.POLICY if name == SKIP_PENDING else registry.get(name)


def check(names: Iterable[str]) -> None:
    """All of these are policies."""
    for name in names:
        policy(name)


def new_queue(chosen: Policy, capacity: int) -> PolicyQueue:
    """A queue for the messages of up to ``PLACES`` topics, or of one for a policy that knows none."""
    from bufgym.live import PolicyQueue
    from bufgym.model.topics import Topic

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
