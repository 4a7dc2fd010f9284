"""ROS 2: a relay whose uplink a policy rules, and a publisher of one's own node with a policy's queue.

The relay (``bufgym ros2 send`` on the robot, ``bufgym ros2 receive`` at the other end) leaves all nodes as they are: it
subscribes on the robot, sends over one uplink of ``bufgym.live``, and republishes there. ``Publisher`` stands in for
``node.create_publisher`` in one's own node, and sends to the same receiver.
"""

from bufgym.ros2.publisher import Publisher

__all__ = ["Publisher"]
