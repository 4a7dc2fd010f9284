"""An ordinary rospy node: prints the number of each frame of ``camera.py`` as it comes.

python3 viewer.py
"""

import rospy
from sensor_msgs.msg import CompressedImage


def main() -> None:
    rospy.init_node("viewer", anonymous=True)
    rospy.Subscriber("/camera", CompressedImage, lambda frame: print(frame.format, flush=True))
    rospy.spin()


if __name__ == "__main__":
    main()
