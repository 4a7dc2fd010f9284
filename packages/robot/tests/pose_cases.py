"""Messages that say where a robot is, or where it shall go."""

import functools
import math

from ros_cases import made

from bufgym.traces.formats.bag_poses import ODOMETRY, typestore

POSE, ESTIMATE = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/PoseWithCovarianceStamped"
TF = "tf2_msgs/msg/TFMessage"


def message(
    type: str, second: int, x_m: float, frame: str, child: str = "base", encoding: str = "cdr", yaw: float = 0.0
) -> bytes:
    """A robot at (x, 0, 0), turned by yaw, at this second."""
    store = typestore(encoding)
    of = functools.partial(made, store)
    stamp = of("builtin_interfaces/msg/Time", sec=second)
    header = of("std_msgs/msg/Header", stamp=stamp, frame_id=frame)
    turn = of("geometry_msgs/msg/Quaternion", z=math.sin(yaw / 2), w=math.cos(yaw / 2))
    if type == TF:
        place = of("geometry_msgs/msg/Transform", translation=of("geometry_msgs/msg/Vector3", x=x_m), rotation=turn)
        stamped = of("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=place)
        whole = of(TF, transforms=[stamped])
    else:
        pose = of("geometry_msgs/msg/Pose", position=of("geometry_msgs/msg/Point", x=x_m), orientation=turn)
        if type != POSE:
            pose = of("geometry_msgs/msg/PoseWithCovariance", pose=pose)
        more = {"child_frame_id": child} if type == ODOMETRY else {}
        whole = of(type, header=header, pose=pose, **more)
    return bytes(store.serialize_ros1(whole, type) if encoding == "ros1" else store.serialize_cdr(whole, type))
