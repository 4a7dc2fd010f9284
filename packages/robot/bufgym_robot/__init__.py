"""The simulator's sender on a real link: the same compiled transition function, driven by a clock.

``PolicyQueue`` is a queue ruled by any registered policy. A ``Sender`` sends its messages over one of ``TRANSPORTS``
and reports when each has left. ``Receiver`` is the other end, and ``ShapedLink`` plays a trace between both. ``replay``
runs the queue's log through the simulator, which makes the same decisions, bit for bit. ``Robot``, ``RobotClient`` and
``Session`` connect to a relay (``bufgym_relay``), of which this package knows the ``wire`` alone.
"""

from typing import TYPE_CHECKING, Any

from bufgym.utils.libraries import needs
from bufgym.utils.modules import on_demand

if TYPE_CHECKING:
    from bufgym_robot.channels import TRANSPORTS
    from bufgym_robot.fleet.bag import BagSource
    from bufgym_robot.fleet.client import RobotClient
    from bufgym_robot.fleet.robot import Robot, Source
    from bufgym_robot.receiver import Received, Receiver, Recording
    from bufgym_robot.replaying import Replay, replay
    from bufgym_robot.sender import Sender
    from bufgym_robot.shaped import ShapedLink
    from bufgym_robot.wire.address import security, token
    from bufgym_robot.wire.log import LogFile, read_log
    from bufgym_robot.wire.messages import Message, RefusedError
    from bufgym_robot.wire.odometry import Odometry
    from bufgym_robot.wire.queue import Item, PolicyQueue
    from bufgym_robot.wire.session import Session

__version__ = "0.2.0"
__all__ = [
    "TRANSPORTS", "BagSource", "Item", "LogFile", "Message", "Odometry", "PolicyQueue", "Received", "Receiver",
    "Recording", "RefusedError", "Replay", "Robot", "RobotClient", "Sender", "Session", "ShapedLink", "Source",
    "read_log", "replay", "security", "token",
]  # fmt: skip
_on_demand = on_demand(__name__, {
    "TRANSPORTS": "channels", "BagSource": "fleet.bag", "RobotClient": "fleet.client", "Robot": "fleet.robot",
    "Source": "fleet.robot", "Received": "receiver", "Receiver": "receiver", "Recording": "receiver",
    "Replay": "replaying", "replay": "replaying", "Sender": "sender", "ShapedLink": "shaped",
    "security": "wire.address", "token": "wire.address", "LogFile": "wire.log", "read_log": "wire.log",
    "Message": "wire.messages", "RefusedError": "wire.messages", "Odometry": "wire.odometry", "Item": "wire.queue",
    "PolicyQueue": "wire.queue", "Session": "wire.session"
})  # fmt: skip


def __getattr__(name: str) -> Any:
    with needs("msgspec", "bufgym-robot[relay]", "bufgym_robot"):  # the other libraries of the extra come with it
        return _on_demand(name)
