"""An ordinary rclpy node, which knows nothing of bufgym: a camera of 230 kB frames at 30 Hz.

python3 camera.py --frames 600
"""

import argparse

import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CompressedImage


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--rate", type=float, default=30.0, help="Hz")
    parser.add_argument("--size", type=int, default=230_000, help="bytes")
    parser.add_argument("--best-effort", action="store_true")
    parser.add_argument("--depth", type=int, default=15)
    options = parser.parse_args()

    rclpy.init()
    node = rclpy.create_node("camera")
    reliability = ReliabilityPolicy.BEST_EFFORT if options.best_effort else ReliabilityPolicy.RELIABLE
    quality = QoSProfile(depth=options.depth, reliability=reliability)
    publisher = node.create_publisher(CompressedImage, "/camera", quality)
    while publisher.get_subscription_count() == 0:
        rclpy.spin_once(node, timeout_sec=0.01)
    sent = 0

    def publish() -> None:
        nonlocal sent
        if sent < options.frames:
            publisher.publish(CompressedImage(format=str(sent), data=bytes(options.size)))
            sent += 1

    node.create_timer(1 / options.rate, publish)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
