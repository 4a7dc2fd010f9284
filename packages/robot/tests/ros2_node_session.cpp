// Drives bufgym::SenderNode over the double of rclcpp, by lines of input; each answers with one line of JSON.
//   make NAMESPACE NAME=VALUE...      the node, with these parameters
//   offer TOPIC TYPE NODE best_effort|reliable|latched DEPTH  a publisher
//   gone TOPIC NODE                   it is no more
//   configure, activate, deactivate, cleanup, shutdown        the state that follows
//   pass SECONDS                      the subscriptions, after the timers that are due in this time
//   set NAME VALUE                    why not, or nothing
//   publish TOPIC COUNT BYTES HZ [NODE]   how many reached a subscription, also one that the node has let go
//   odometry TOPIC X                  a pose at X metres
//   diagnostics                       the newest
//   end                               threads that are left without the node
#include <filesystem>
#include <iostream>
#include <sstream>
#include <thread>

#include <diagnostic_msgs/msg/diagnostic_array.hpp>
#include <nav_msgs/msg/odometry.hpp>

#include "rclcpp_lifecycle_double.hpp"

std::shared_ptr<rclcpp_lifecycle::LifecycleNode> make_node(const rclcpp::NodeOptions &options);

namespace
{
std::shared_ptr<rclcpp_lifecycle::LifecycleNode> node;

rclcpp::ParameterValue value_of(const std::string &text)
{
  if (text == "true" || text == "false")
    return rclcpp::ParameterValue(text == "true");
  if (!text.empty() && text.find_first_not_of("-0123456789") == std::string::npos)
    return rclcpp::ParameterValue(int64_t(std::stoll(text)));
  if (text.empty() || text[0] != '[')
    return rclcpp::ParameterValue(text);
  std::vector<std::string> all;
  std::istringstream words(text.substr(1, text.size() - 2));
  for (std::string word; std::getline(words, word, ',');)
    all.push_back(word);
  return rclcpp::ParameterValue(all);
}

std::string quoted(const std::string &text) { return '"' + text + '"'; }

std::string subscriptions()
{
  std::ostringstream out;
  for (const auto &one : world.subscriptions)
  {
    const bool held = one.use_count() > 1;  // by the node too
    const bool reliable = one->qos.reliability() == rclcpp::ReliabilityPolicy::Reliable;
    out << (out.tellp() ? ", " : "") << "[" << quoted(one->topic) << ", " << quoted(one->type) << ", "
        << one->qos.depth() << ", " << reliable << ", " << held << "]";
  }
  return "[" + out.str() + "]";
}

// Call the timers that are due, in their order; a cancelled one is held and not called.
void pass(double seconds)
{
  const auto until = world.now + std::chrono::nanoseconds(int64_t(seconds * 1e9));
  for (;;)
  {
    rclcpp::TimerBase::SharedPtr next;
    for (const auto &timer : world.timers)
      if (!timer->cancelled && timer->due <= until && (!next || timer->due < next->due))
        next = timer;
    if (!next)
      break;
    world.now = next->due;
    next->due += next->period;
    next->call();
  }
  world.now = until;
}

// The publisher's id is its node's name.
int publish(const std::string &topic, int count, size_t bytes, double hz, const std::string &node)
{
  int reached = 0;
  rmw_message_info_t about = {};
  about.source_timestamp = 5000000;
  std::copy_n(node.data(), std::min<size_t>(node.size(), RMW_GID_STORAGE_SIZE), about.publisher_gid.data);
  const rclcpp::MessageInfo info(about);
  auto due = std::chrono::steady_clock::now();
  for (int k = 0; k < count; k++)
  {
    const auto message = std::make_shared<const rclcpp::SerializedMessage>(std::vector<uint8_t>(bytes, uint8_t(k)));
    for (const auto &one : world.subscriptions)
      if (one->topic == topic)
      {
        one->call(message, info);
        reached++;
      }
    std::this_thread::sleep_until(due += std::chrono::microseconds(int64_t(1e6 / hz)));
  }
  return reached;
}

std::string diagnostics()
{
  const auto &all = world.published["/diagnostics"];
  std::ostringstream out;
  if (!all.empty())
    for (const auto &status : std::static_pointer_cast<const diagnostic_msgs::msg::DiagnosticArray>(all.back())->status)
    {
      out << (out.tellp() ? ", " : "") << quoted(status.name) << ": {\"message\": " << quoted(status.message);
      for (const auto &pair : status.values)
        out << ", " << quoted(pair.key) << ": " << pair.value;
      out << "}";
    }
  return "{" + out.str() + "}";
}

void odometry(const std::string &topic, double x)
{
  auto pose = std::make_shared<nav_msgs::msg::Odometry>();
  pose->header.stamp.sec = int32_t(x * 10);
  pose->pose.pose.position.x = x;
  pose->pose.pose.orientation.w = 1;
  world.typed.at(topic)(pose);
}

std::string answer(const std::string &command, std::istream &words)
{
  std::string name, type, who, reliability;
  double number = 0;
  size_t count = 0, bytes = 0;
  if (command == "make")
  {
    rclcpp::NodeOptions options;
    words >> options.space;
    while (words >> name)
      options.overrides.emplace(name.substr(0, name.find('=')), value_of(name.substr(name.find('=') + 1)));
    try
    {
      node = make_node(options);
    }
    catch (const std::exception &error)  // as main.cpp does, which ends with exit code 2
    {
      return quoted(error.what());
    }
  }
  else if (command == "offer")
  {
    words >> name >> type >> who >> reliability >> count;
    rclcpp::QoS qos{rclcpp::KeepLast(count)};
    using Policy = rclcpp::ReliabilityPolicy;
    qos.reliability(reliability == "best_effort" ? Policy::BestEffort : Policy::Reliable);
    if (reliability == "latched")
      qos.durability(rclcpp::DurabilityPolicy::TransientLocal);
    world.publishers.emplace(name, rclcpp::TopicEndpointInfo(who, type, qos));
  }
  else if (command == "gone")
  {
    words >> name >> who;
    for (auto one = world.publishers.begin(); one != world.publishers.end();)
      one = one->first == name && one->second.node_name() == who ? world.publishers.erase(one) : std::next(one);
  }
  else if (command == "pass")
  {
    words >> number;
    pass(number);
    return subscriptions();
  }
  else if (command == "set")
  {
    words >> name >> type;
    const auto result = node->set_parameter({name, value_of(type)});
    return quoted(result.successful ? "" : result.reason);
  }
  else if (command == "publish")
  {
    words >> name >> count >> bytes >> number;
    if (!std::getline(words >> std::ws, who))
      who.clear();
    return std::to_string(publish(name, int(count), bytes, number, who));
  }
  else if (command == "odometry")
  {
    words >> name >> number;
    odometry(name, number);
  }
  else if (command == "diagnostics")
    return diagnostics();
  else if (command == "end")
  {
    node.reset();
    using Folder = std::filesystem::directory_iterator;
    return std::to_string(std::distance(Folder("/proc/self/task"), Folder()));
  }
  else
  {
    const auto &state = command == "configure"    ? node->configure()
                        : command == "activate"   ? node->activate()
                        : command == "deactivate" ? node->deactivate()
                        : command == "cleanup"    ? node->cleanup()
                                                  : node->shutdown();
    return std::to_string(state.id());
  }
  return std::to_string(node ? node->get_current_state().id() : 0);
}
}

int main()
{
  for (std::string line; std::getline(std::cin, line);)
  {
    std::istringstream words(line);
    std::string command;
    words >> command;
    std::cout << answer(command, words) << std::endl;
  }
}
