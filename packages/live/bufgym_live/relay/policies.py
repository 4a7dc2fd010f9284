"""Policies of subscribers' queues: any of the relay's policies by name, including Robofleet's server rule.

A relay listens before any policy is loaded. Modules that compile are imported at first use, by ``warm`` in a thread.
"""

from __future__ import annotations

import contextlib
import functools
import signal
import threading
from typing import TYPE_CHECKING, Final, TypeAlias

from bufgym.utils.errors import BufgymError
from bufgym.utils.processes import compiling
from bufgym_live.relay.plain import PLAIN, Latest

if TYPE_CHECKING:
    from bufgym.policies.registry import Policy
    from bufgym_live.robot import PolicyQueue

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
    from bufgym_live.robot import PolicyQueue

    topics = tuple(Topic(f"/{k}") for k in range(PLACES)) if chosen.for_topics else ()
    return PolicyQueue(chosen, capacity, topics=topics, room=ROOM)


@functools.lru_cache(256)
def warm(name: str) -> Rule:
    """Compile the policy of this name by sending one message through a queue; return the policy."""
    chosen = policy(name)
    return chosen if isinstance(chosen, type) else compiled(chosen)


def compiled(chosen: Policy) -> Policy:
    """Compile a policy that is given as an object.

    Another process compiles a policy that is not cached yet, so that clients can connect meanwhile. That process knows
    all policies except user-defined ones.
    """
    with _COMPILING:
        if not is_cached(chosen) and compiling(__name__, "fill_cache", chosen.name) < 0:
            raise BufgymError(f"policy {chosen.name}: stopped while it was compiled")
        _used(chosen)
        return chosen


def is_cached(chosen: Policy) -> bool:
    """Whether the policy is in the compiler's cache; if so, load it."""
    from bufgym.jit import NotCachedError, cached_only

    try:
        with cached_only():
            _used(chosen)
    except NotCachedError:
        return False
    return True


def fill_cache(name: str) -> None:
    """Compile the policy of this name, in a process of its own; leave a user-defined one to its own process."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    with contextlib.suppress(BufgymError):
        _used(policy(name))


def _used(chosen: Rule) -> None:
    """Send one message through a queue with this policy."""
    queue = new_queue(chosen, PLACES)
    queue.put(b"", 1, topic=0)
    queue.get(0)
    queue.gone()
