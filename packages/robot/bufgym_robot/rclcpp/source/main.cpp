// The program `sender`: the node alone. What is wrong with its parameters is one line, and the exit code is 2.
#include <cstdio>
#include <exception>
#include <memory>

#include <rclcpp/rclcpp.hpp>
#include <rclcpp_lifecycle/lifecycle_node.hpp>

std::shared_ptr<rclcpp_lifecycle::LifecycleNode> make_sender(const rclcpp::NodeOptions &options);  // node.cpp

int main(int argc, char **argv)
{
  int code = 0;
  try
  {
    rclcpp::init(argc, argv);
    const auto node = make_sender(rclcpp::NodeOptions());
    rclcpp::executors::SingleThreadedExecutor executor;
    executor.add_node(node->get_node_base_interface());
    executor.spin();
  }
  catch (const std::exception &error)
  {
    std::fprintf(stderr, "bufgym_sender: error: %s\n", error.what());
    code = 2;
  }
  if (rclcpp::ok())
    rclcpp::shutdown();
  return code;
}
