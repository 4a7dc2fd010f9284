"""The simulator's sender on a real link: the same compiled transition function, driven by a clock.

``PolicyQueue`` is a queue ruled by any registered policy. A ``Sender`` sends its messages over one of ``TRANSPORTS``
and reports when each has left. ``Receiver`` is the other end, and ``ShapedLink`` plays a trace between both. ``replay``
runs the queue's log through the simulator, which makes the same decisions, bit for bit.
"""

from typing import TYPE_CHECKING

from bufgym.utils.modules import on_demand

if TYPE_CHECKING:
    from bufgym_robot.channels import TRANSPORTS
    from bufgym_robot.log import LogFile, read_log
    from bufgym_robot.odometry import Odometry
    from bufgym_robot.queue import Item, PolicyQueue
    from bufgym_robot.receiver import Received, Receiver, Recording
    from bufgym_robot.replaying import Replay, replay
    from bufgym_robot.sender import Sender
    from bufgym_robot.shaped import ShapedLink

__all__ = [
    "TRANSPORTS", "Item", "LogFile", "Odometry", "PolicyQueue", "Received", "Receiver", "Recording", "Replay", "Sender",
    "ShapedLink", "read_log", "replay",
]  # fmt: skip
__getattr__ = on_demand(__name__, {
    "TRANSPORTS": "channels", "LogFile": "log", "read_log": "log", "Odometry": "odometry", "Item": "queue",
    "PolicyQueue": "queue", "Received": "receiver", "Receiver": "receiver", "Recording": "receiver",
    "Replay": "replaying", "replay": "replaying", "Sender": "sender", "ShapedLink": "shaped"
})  # fmt: skip
