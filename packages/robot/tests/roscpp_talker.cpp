// talker TOPIC[,TOPIC...] QUEUE_SIZE MESSAGES BYTES HZ [SUBSCRIBERS [moves]]: publishes images on all topics; their
// frame_id is their number. It waits for so many subscribers of each topic (1); with 0 the topics are latched.
#include <algorithm>
#include <clocale>
#include <cstdlib>
#include <sstream>
#include <string>
#include <vector>

#include <nav_msgs/Odometry.h>
#include <ros/ros.h>
#include <sensor_msgs/CompressedImage.h>

int main(int argc, char **argv)
{
  std::setlocale(LC_ALL, "");  // as Qt and GTK do
  ros::init(argc, argv, "talker", ros::init_options::AnonymousName);
  ros::NodeHandle node;
  const int count = std::atoi(argv[3]), subscribers = argc > 6 ? std::atoi(argv[6]) : 1;
  const bool moves = argc > 7, latched = subscribers == 0;
  std::vector<ros::Publisher> images;
  std::istringstream topics(argv[1]);
  for (std::string topic; std::getline(topics, topic, ',');)
    images.push_back(node.advertise<sensor_msgs::CompressedImage>(topic, std::atoi(argv[2]), latched));
  ros::Publisher odometry = node.advertise<nav_msgs::Odometry>("odom", 10);
  const auto have = [&images](int wanted) {
    return std::all_of(images.begin(), images.end(),
                       [wanted](const ros::Publisher &one) { return int(one.getNumSubscribers()) >= wanted; });
  };
  while (ros::ok() && !have(subscribers))
    ros::WallDuration(0.02).sleep();
  ros::WallRate rate(std::atof(argv[5]));
  for (int k = 0; ros::ok() && k < count; k++)
  {
    if (moves)
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
    for (ros::Publisher &one : images)
      one.publish(image);
    ros::spinOnce();
    rate.sleep();
  }
  ROS_WARN("published");  // a warning is not buffered
  const auto any = [&images] {
    return std::any_of(images.begin(), images.end(),
                       [](const ros::Publisher &one) { return one.getNumSubscribers() > 0; });
  };
  while (ros::ok() && (any() || latched))  // until the last of them has what it wants
    ros::WallDuration(0.05).sleep();
}
