"""The simulator's sender on a real link: the same compiled transition, with a clock as its argument.

``PolicyQueue`` is a queue that any registered policy rules. Transports send what it hands out and tell it when that
has left; ``Receiver`` is the other end, ``ShapedLink`` a trace between the two. What happened is logged, and
``replay`` runs a log through the simulator, which makes the same decisions, bit for bit.
"""

from bufgym.live.log import LogFile, read_log
from bufgym.live.queue import Item, PolicyQueue
from bufgym.live.replay import Replay, replay

__all__ = ["Item", "LogFile", "PolicyQueue", "Replay", "read_log", "replay"]
