// talker TOPIC QUEUE_SIZE MESSAGES BYTES HZ [latched | moves]: publishes images; their frame_id is their number.
#include <cstdlib>
#include <string>

#include <nav_msgs/Odometry.h>
#include <ros/ros.h>
#include <sensor_msgs/CompressedImage.h>

int main(int argc, char **argv)
{
  ros::init(argc, argv, "talker", ros::init_options::AnonymousName);
  ros::NodeHandle node;
  const std::string mode = argc > 6 ? argv[6] : "";
  const int count = std::atoi(argv[3]);
  ros::Publisher images = node.advertise<sensor_msgs::CompressedImage>(argv[1], std::atoi(argv[2]), mode == "latched");
  ros::Publisher odometry = node.advertise<nav_msgs::Odometry>("odom", 10);
  while (ros::ok() && mode != "latched" && images.getNumSubscribers() == 0)
    ros::WallDuration(0.02).sleep();
  ros::WallDuration(0.5).sleep();
  ros::WallRate rate(std::atof(argv[5]));
  for (int k = 0; ros::ok() && k < count; k++)
  {
    if (mode == "moves")
    {
      nav_msgs::Odometry moved;
      moved.header.stamp = ros::Time(1000 + k / 20.0);
      moved.header.frame_id = "odom";
      moved.pose.pose.position.x = 0.1 * k;
      moved.pose.pose.orientation.w = 1;
      odometry.publish(moved);
    }
    sensor_msgs::CompressedImage image;
    image.header.frame_id = std::to_string(k);
    image.data.resize(std::atoi(argv[4]));
    images.publish(image);
    ros::spinOnce();
    rate.sleep();
  }
  while (ros::ok() && (images.getNumSubscribers() > 0 || mode == "latched"))  // until they have what they want
    ros::WallDuration(0.05).sleep();
}
