"""Messages that say where a robot is, or where it shall go."""

import math
from typing import Any

import numpy as np

from bufgym.traces.formats.bag_poses import ODOMETRY, typestore

POSE, ESTIMATE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
TF = "tf2_msgs/msg/TFMessage"


def message(
    type: str, second: int, x_m: float, frame: str, child: str = "base", encoding: str = "cdr", yaw: float = 0.0
) -> bytes:
    """A robot at (x, 0, 0), turned by yaw, at this second."""
    store = typestore(encoding)
    kinds, old = store.types, {"seq": 0} if encoding == "ros1" else {}
    stamp = kinds["builtin_interfaces/msg/Time"](sec=second, nanosec=0)
    header = kinds["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **old)
    vector, z, w = kinds["geometry_msgs/msg/Vector3"], math.sin(yaw / 2), math.cos(yaw / 2)
    turn = kinds["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=z, w=w)
    if type == TF:
        transform = kinds["geometry_msgs/msg/Transform"](translation=vector(x=x_m, y=0.0, z=0.0), rotation=turn)
        stamped = kinds["geometry_msgs/msg/TransformStamped"](header=header, child_frame_id=child, transform=transform)
        made = kinds[TF](transforms=[stamped])
    else:
        point = kinds["geometry_msgs/msg/Point"](x=x_m, y=0.0, z=0.0)
        pose = kinds["geometry_msgs/msg/Pose"](position=point, orientation=turn)
        more: dict[str, Any] = {}
        if type != POSE:
            pose = kinds["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36))
        if type == ODOMETRY:
            zero = vector(x=0.0, y=0.0, z=0.0)
            still = kinds["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
            twist = kinds["geometry_msgs/msg/TwistWithCovariance"](twist=still, covariance=np.zeros(36))
            more = {"child_frame_id": child, "twist": twist}
        made = kinds[type](header=header, pose=pose, **more)
    return bytes(store.serialize_ros1(made, type) if encoding == "ros1" else store.serialize_cdr(made, type))
