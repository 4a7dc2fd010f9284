"""How a subscriber's queue decides: any of the relay's policies by name, and what Robofleet's server does.

A relay listens before it knows any: what compiles is imported where it is used, first by ``warm`` in a thread.
"""

from __future__ import annotations

import contextlib
import functools
import signal
import subprocess
import sys
import threading
from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

from bufgym.errors import BufgymError

if TYPE_CHECKING:
    from bufgym.live import PolicyQueue
    from bufgym.policies.registry import Policy

SKIP_PENDING: Final = "skip-pending"
PLACES: Final = 32
"""Topics that share a queue, where the policy knows topics."""
ROOM: Final = 64
"""Messages between two tidyings of a queue's bookkeeping: little, as there are many queues."""
_COMPILING: Final = threading.Lock()


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
    """The same for one that has no name here.

    What is not kept yet is compiled by another process, which knows all policies but one's own: for tens of seconds the
    compiler would hold this one's lock, and nobody be welcomed.
    """
    with _COMPILING:
        if not kept(chosen):
            command = [sys.executable, "-m", __name__, chosen.name]
            if subprocess.run(command, stdin=subprocess.DEVNULL).returncode < 0:
                raise BufgymError(f"policy {chosen.name}: stopped while it was compiled")
        return _used(chosen)


def kept(chosen: Policy) -> bool:
    """Whether nothing has to be compiled for it; if so, it is loaded."""
    from bufgym.kernel import NotKeptError, only_kept

    try:
        with only_kept():
            _used(chosen)
    except NotKeptError:
        return False
    return True


def _used(chosen: Policy) -> Policy:
    """One message goes through a queue of it."""
    queue = new_queue(chosen, PLACES)
    queue.put(b"", 1)
    queue.get(0)
    queue.gone()
    return queue.policy


if __name__ == "__main__":  # compiles the policy of this name
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    with contextlib.suppress(BufgymError):  # one's own: whoever has it compiles it
        _used(policy(sys.argv[1]))
