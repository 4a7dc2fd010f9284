"""The simulator's sender on a real link: the same compiled transition function, driven by a clock.

``PolicyQueue`` is a queue ruled by any registered policy. A transport sends its messages and reports when each has
left. ``Receiver`` is the other end, and ``ShapedLink`` plays a trace between the two. ``replay`` runs the queue's log
through the simulator, which makes the same decisions, bit for bit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bufgym.robot.log import LogFile, read_log
    from bufgym.robot.queue import Item, PolicyQueue
    from bufgym.robot.replaying import Replay, replay

__all__ = ["Item", "LogFile", "PolicyQueue", "Replay", "read_log", "replay"]


def __getattr__(name: str) -> Any:
    """Import the compiled parts at first use, so that a relay, which needs only the sockets, starts three times
    faster."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from bufgym.robot import log, queue, replaying

    return next(getattr(home, name) for home in (log, queue, replaying) if hasattr(home, name))
