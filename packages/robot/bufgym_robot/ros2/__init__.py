"""ROS 2: a relay with an uplink ruled by a policy, and a publisher with a policy's queue for your own node.

The relay needs no change of any node. ``bufgym ros2 send`` subscribes on the robot and sends over one uplink of
``bufgym_robot``. ``bufgym ros2 receive`` republishes at the other end. ``Publisher`` replaces
``node.create_publisher`` in your own node, and sends to the same receiver.
"""

from typing import TYPE_CHECKING

from bufgym.utils.modules import on_demand

if TYPE_CHECKING:
    from bufgym_robot.ros2.publisher import Publisher

__all__ = ["Publisher"]
# The commands say first whether policies run compiled, and Publisher would import the compiler before that.
__getattr__ = on_demand(__name__, {"Publisher": "publisher"})
