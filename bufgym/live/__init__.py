"""The simulator's sender on a real link: the same compiled transition, with a clock as its argument.

``PolicyQueue`` is a queue that any registered policy rules. Transports send what it hands out and tell it when that
has left; ``Receiver`` is the other end, ``ShapedLink`` a trace between the two. What happened is logged, and
``replay`` runs a log through the simulator, which makes the same decisions, bit for bit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bufgym.live.log import LogFile, read_log
    from bufgym.live.queue import Item, PolicyQueue
    from bufgym.live.replaying import Replay, replay

__all__ = ["Item", "LogFile", "PolicyQueue", "Replay", "read_log", "replay"]


def __getattr__(name: str) -> Any:
    """Not at start-up: these need the compiler, and a relay that wants the sockets is up in a third of the time."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from bufgym.live import log, queue, replaying

    return next(getattr(home, name) for home in (log, queue, replaying) if hasattr(home, name))
