"""An ordinary rclpy node: prints the number of each frame of ``camera.py`` as it comes.

python3 viewer.py
"""

import argparse

import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--best-effort", action="store_true")
    options = parser.parse_args()

    rclpy.init()
    node = rclpy.create_node("viewer")
    reliability = ReliabilityPolicy.BEST_EFFORT if options.best_effort else ReliabilityPolicy.RELIABLE
    quality = QoSProfile(depth=100, reliability=reliability)
    node.create_subscription(CompressedImage, "/camera", lambda frame: print(frame.format, flush=True), quality)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
