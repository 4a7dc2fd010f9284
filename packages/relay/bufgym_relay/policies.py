"""Policies of subscribers' queues: any of the relay's policies by name, including Robofleet's server rule.

A relay listens before any policy is loaded. Modules that compile are imported at first use, by ``warm`` in a thread.
"""

from __future__ import annotations

import functools
import threading
from typing import TYPE_CHECKING, Final, TypeAlias

from bufgym_relay.plain import PLAIN, Latest

if TYPE_CHECKING:
    from bufgym.policies.registry import Policy
    from bufgym_robot.wire.queue import PolicyQueue

Rule: TypeAlias = "Policy | type[Latest]"
PLACES: Final = 32  # Topics that share a queue, where the policy knows topics
ROOM: Final = 64  # Messages between two cleanups of a queue's bookkeeping; few, because there are many queues
_COMPILING: Final = threading.Lock()


def policy(name: str) -> Rule:
    """Find the policy of this name; it may have settings, as in ``decimate:every=2``."""
    if name in PLAIN:
        return PLAIN[name]
    from bufgym.policies import registry

    return registry.get(name)


def new_queue(chosen: Rule, capacity: int) -> PolicyQueue | Latest:
    """Make a queue for up to ``PLACES`` topics, or for one topic if the policy knows none."""
    if isinstance(chosen, type):
        return chosen(capacity)
    from bufgym.model.topics import Topic
    from bufgym_robot.wire.queue import PolicyQueue

    topics = tuple(Topic(f"/{k}") for k in range(PLACES)) if chosen.for_topics else ()
    return PolicyQueue(chosen, capacity, topics=topics, room=ROOM)


@functools.lru_cache(256)
def warm(name: str) -> Rule:
    """Compile the policy of this name by sending one message through a queue; return the policy."""
    chosen = policy(name)
    return chosen if isinstance(chosen, type) else compiled(chosen)


def compiled(chosen: Policy) -> Policy:
    """Compile a policy that is given as an object, if it is not yet."""
    with _COMPILING:
        _used(chosen)
    return chosen


def _used(chosen: Rule) -> None:
    """Send one message through a queue with this policy."""
    queue = new_queue(chosen, PLACES)
    queue.put(b"", 1, topic=0)
    queue.get(0)
    queue.gone()
