"""An ordinary rospy node, which knows nothing of bufgym: a camera of 230 kB frames at 30 Hz.

python3 camera.py --frames 600
python3 -m bufgym_robot.ros1 --policy afr camera.py --frames 600
"""

import argparse

import rospy
from sensor_msgs.msg import CompressedImage


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--rate", type=float, default=30.0, help="Hz")
    parser.add_argument("--size", type=int, default=230_000, help="bytes")
    parser.add_argument("--queue-size", type=int, default=15)
    options = parser.parse_args(rospy.myargv()[1:])

    rospy.init_node("camera")
    publisher = rospy.Publisher("/camera", CompressedImage, queue_size=options.queue_size)
    while publisher.get_num_connections() == 0 and not rospy.is_shutdown():
        rospy.sleep(0.01)
    rate = rospy.Rate(options.rate)
    for k in range(options.frames):
        frame = CompressedImage(format=str(k), data=bytes(options.size))
        frame.header.stamp = rospy.Time.now()
        publisher.publish(frame)
        rate.sleep()
    rospy.spin()


if __name__ == "__main__":
    main()
