// bufgym::SenderNode: a component with a lifecycle, which sends topics of any type. Each topic has a queue under a
// policy and a connection of its own to `bufgym ros2 receive`.
#include <fnmatch.h>

#include <algorithm>
#include <chrono>
#include <functional>
#include <map>
#include <memory>
#include <set>
#include <stdexcept>
#include <string>
#include <vector>

#include <diagnostic_msgs/msg/diagnostic_array.hpp>
#include <lifecycle_msgs/msg/state.hpp>
#include <nav_msgs/msg/odometry.hpp>
#include <rcl_interfaces/msg/parameter_descriptor.hpp>
#include <rcl_interfaces/msg/set_parameters_result.hpp>
#include <rclcpp/create_generic_subscription.hpp>
#include <rclcpp/rclcpp.hpp>
#include <rclcpp_components/register_node_macro.hpp>
#include <rclcpp_lifecycle/lifecycle_node.hpp>

#include "motion.h"
#include "publishers.h"
#include "sender.h"

namespace bufgym
{
using namespace std::chrono_literals;
using rclcpp_lifecycle::node_interfaces::LifecycleNodeInterface;

// Patterns leave these out, which every node has or which are this node's own.
const std::vector<std::string> NOT_BY_PATTERN = {
    "/rosout", "/parameter_events", "/clock", "/tf", "/diagnostics"};

class SenderNode : public rclcpp_lifecycle::LifecycleNode
{
public:
  using CallbackReturn = LifecycleNodeInterface::CallbackReturn;

  explicit SenderNode(const rclcpp::NodeOptions &options) : LifecycleNode("bufgym_sender", options)
  {
    declare(
        "topics", std::vector<std::string>{},
        "Topics to send, also patterns with * and ?; relative names stand in the namespace");
    declare("host", std::string("127.0.0.1"), "Where bufgym ros2 receive listens; may change at any time");
    declare("port", 7410, "Its port; may change at any time", 1, 65535);
    declare("policy", std::string("learned"), "Which message is dropped when a queue is full: " + known());
    declare("value", std::string(), "V, one for all nodes of the process: exponential:BASE or saturating:DISTANCE");
    declare("capacity", 15, "L, messages of each queue; also the depth of the subscription", 1, MOST);
    declare(
        "odometry", std::string(), "Topic of nav_msgs/Odometry from which x is summed; without it x counts messages");
    declare("log", std::string(), "Folder for a log of each queue, which bufgym live replay reads");
    declare("autostart", true, "Whether the node configures and activates itself");
    changes_ = add_on_set_parameters_callback(std::bind(&SenderNode::change, this, std::placeholders::_1));
    if (!get_parameter("autostart").as_bool())
      return;
    if (const std::string wrong = configuration(); !wrong.empty())  // nobody would set it right
      throw std::invalid_argument(wrong);
    start_ = create_wall_timer(0s, [this] {
      start_->cancel();
      if (configure().id() == lifecycle_msgs::msg::State::PRIMARY_STATE_INACTIVE)
        activate();
    });
  }

  ~SenderNode() override { stop(); }

  CallbackReturn on_configure(const rclcpp_lifecycle::State &) override
  {
    if (const std::string wrong = configuration(); !wrong.empty())
    {
      RCLCPP_ERROR(get_logger(), "%s", wrong.c_str());
      return CallbackReturn::FAILURE;
    }
    capacity_ = int(get_parameter("capacity").as_int());
    diagnostics_ = create_publisher<diagnostic_msgs::msg::DiagnosticArray>("/diagnostics", 10);
    return CallbackReturn::SUCCESS;
  }

  CallbackReturn on_activate(const rclcpp_lifecycle::State &state) override
  {
    const std::string odometry = get_parameter("odometry").as_string();
    if (!odometry.empty())
    {
      motion_ = std::make_shared<Motion>();
      odometry_ = create_subscription<nav_msgs::msg::Odometry>(
          odometry, rclcpp::SensorDataQoS().keep_last(100),
          [motion = motion_](nav_msgs::msg::Odometry::ConstSharedPtr message) {
            const auto &p = message->pose.pose.position;
            const auto &o = message->pose.pose.orientation;
            const double time_s = rclcpp::Time(message->header.stamp).seconds();
            motion->take(message->header.frame_id, time_s, {p.x, p.y, p.z}, {o.x, o.y, o.z, o.w});
          });
    }
    look_ = create_wall_timer(200ms, [this] { look(); });
    tell_ = create_wall_timer(1s, [this] { tell(); });
    return LifecycleNode::on_activate(state);
  }

  CallbackReturn on_deactivate(const rclcpp_lifecycle::State &state) override
  {
    stop();
    return LifecycleNode::on_deactivate(state);
  }

  CallbackReturn on_cleanup(const rclcpp_lifecycle::State &) override
  {
    diagnostics_.reset();
    return CallbackReturn::SUCCESS;
  }

  CallbackReturn on_shutdown(const rclcpp_lifecycle::State &) override
  {
    stop();
    diagnostics_.reset();
    return CallbackReturn::SUCCESS;
  }

private:
  struct Sending
  {
    Published topic;
    std::shared_ptr<Sender> sender;
    rclcpp::GenericSubscription::SharedPtr subscription;
  };

  template <class Default>
  void declare(const std::string &name, const Default &at, const std::string &about, int64_t from = 0, int64_t to = 0)
  {
    rcl_interfaces::msg::ParameterDescriptor descriptor;
    descriptor.description = about;
    descriptor.read_only = name == "autostart";
    if (to)
    {
      descriptor.integer_range.resize(1);
      descriptor.integer_range[0].from_value = from;
      descriptor.integer_range[0].to_value = to;
      descriptor.integer_range[0].step = 1;
    }
    declare_parameter(name, at, descriptor);
  }

  // Take policy and V; what is wrong with the parameters, in one line, or nothing.
  std::string configuration()
  {
    const std::string odometry = get_parameter("odometry").as_string(), log = get_parameter("log").as_string();
    const std::string policy = get_parameter("policy").as_string();
    std::string value = get_parameter("value").as_string();
    value = !value.empty() ? value : odometry.empty() ? "exponential:0.618" : "exponential:0.36787944117144233";
    policy_ = find(policy);
    if (!policy_)
      return "policy " + policy + ": must be one of " + known();
    if (!set_value(value))
      return "value " + value + ": must be exponential:BASE or saturating:DISTANCE";
    try
    {
      wanted();
      if (!odometry.empty())
        get_node_topics_interface()->resolve_topic_name(odometry);
    }
    catch (const std::exception &error)
    {
      return std::string("topics and odometry must be names of topics: ") + error.what();
    }
    if (!log.empty() && !Log::writable(log))
      return "log " + log + ": must be a folder that can be written";
    return "";
  }

  Address address() { return {get_parameter("host").as_string(), int(get_parameter("port").as_int())}; }

  // host and port move the connections. The others shape queues, so the node must not be configured.
  rcl_interfaces::msg::SetParametersResult change(const std::vector<rclcpp::Parameter> &parameters)
  {
    rcl_interfaces::msg::SetParametersResult result;
    result.successful = true;
    Address to = address();
    bool moves = false;
    for (const rclcpp::Parameter &one : parameters)
    {
      const std::string &name = one.get_name();
      if (name == "host")
        to.host = one.as_string();
      else if (name == "port")
        to.port = int(one.as_int());
      moves |= name == "host" || name == "port";
      const bool shapes = name == "topics" || name == "policy" || name == "value" || name == "capacity" ||
                          name == "odometry" || name == "log";
      if (shapes && get_current_state().id() != lifecycle_msgs::msg::State::PRIMARY_STATE_UNCONFIGURED)
      {
        result.successful = false;
        result.reason = name + ": deactivate and clean up the node first";
      }
      else if (name == "policy" && !find(one.as_string()))
      {
        result.successful = false;
        result.reason = "policy " + one.as_string() + ": must be one of " + known();
      }
    }
    if (result.successful && moves)
      for (auto &[topic, sending] : sendings_)
        sending.sender->move(to);
    return result;
  }

  // The wanted topics that somebody publishes, with their types.
  std::map<std::string, std::string> wanted()
  {
    const auto all = get_topic_names_and_types();
    std::map<std::string, std::string> found;
    const std::vector<std::string> names = get_parameter("topics").as_string_array();  // a reference into a temporary
    for (const std::string &name : names)
    {
      if (name.empty())
        continue;
      const bool pattern = name.find_first_of("*?[") != std::string::npos;
      const std::string space = get_namespace(), full = space == "/" ? "/" + name : space + "/" + name;
      const std::string resolved = !pattern         ? get_node_topics_interface()->resolve_topic_name(name)
                                   : name[0] == '/' ? name
                                                    : full;
      for (const auto &[topic, types] : all)
      {
        const bool left_out = pattern && std::count(NOT_BY_PATTERN.begin(), NOT_BY_PATTERN.end(), topic);
        if (!left_out && (pattern ? !fnmatch(resolved.c_str(), topic.c_str(), 0) : topic == resolved))
          found[topic] = types.front();
      }
    }
    return found;
  }

  void look()
  {
    std::map<std::string, std::string> found;
    try
    {
      found = wanted();
    }
    catch (const std::exception &error)  // a signal has ended the context under this callback
    {
      RCLCPP_ERROR_THROTTLE(get_logger(), *get_clock(), 10000, "topics: %s", error.what());
    }
    for (const auto &[name, type] : found)
    {
      try
      {
        if (const std::string why = circle(*this, name); !why.empty())
        {
          let_go(name);
          throw std::runtime_error(why);
        }
        Published topic;
        std::set<uint64_t> living;
        const auto known = sendings_.find(name);
        if (!published(*this, name, type, topic, living))
          continue;
        if (known == sendings_.end() || head(known->second.topic) != head(topic))
          subscribe(topic);
        else
          known->second.sender->keep(living);
      }
      catch (const std::exception &error)
      {
        RCLCPP_ERROR_THROTTLE(get_logger(), *get_clock(), 10000, "%s: left out: %s", name.c_str(), error.what());
      }
    }
  }

  // End a topic's sending, also where an executor still holds its subscription.
  void let_go(const std::string &name)
  {
    const auto known = sendings_.find(name);
    if (known == sendings_.end())
      return;
    known->second.subscription.reset();
    known->second.sender->close(0);
    sendings_.erase(known);
  }

  void subscribe(const Published &topic)
  {
    const rclcpp::QoS qos = subscription_qos(*this, topic, capacity_);
    let_go(topic.name);  // its publishers came back with another type or quality of service
    Sending sending;
    sending.topic = topic;
    sending.sender = std::make_shared<Sender>(address(), topic, *policy_, capacity_, get_parameter("log").as_string());
    const bool state = latched(topic) && (TELLS_PUBLISHER || topic.depth == 1);
    // An executor may call it once more when the subscription is gone, and the node.
    sending.subscription = rclcpp::create_generic_subscription(
        get_node_topics_interface(), topic.name, topic.type, qos,
        with_publisher([sender = sending.sender, motion = motion_, state](
                           const auto &data, uint64_t source, int64_t at_us) {
          if (state)
            sender->latch(source, data.buffer, data.buffer_length, at_us);
          else if (motion)
            sender->put(data.buffer, data.buffer_length, motion->x());
          else
            sender->put(data.buffer, data.buffer_length);
        }));
    sendings_[topic.name] = std::move(sending);
    RCLCPP_INFO(
        get_logger(), "%s: %s, %s", topic.name.c_str(), topic.type.c_str(),
        topic.reliable ? "reliable" : "best effort");
  }

  void tell()
  {
    const Point point;
    diagnostic_msgs::msg::DiagnosticArray all;
    all.header.stamp = now();
    for (auto &[name, sending] : sendings_)
    {
      const Numbers n = sending.sender->numbers();
      diagnostic_msgs::msg::DiagnosticStatus status;
      status.name = std::string(get_fully_qualified_name()) + ": " + name;
      status.hardware_id = "bufgym";
      status.level = n.connected ? status.OK : status.WARN;
      status.message = n.connected ? "connected" : "not connected: " + n.fault;
      const std::pair<const char *, double> values[] = {
          {"arrived per s", n.arrived_hz}, {"left per s", n.left_hz}, {"left Mbit/s", n.left_mbps},
          {"arrived", double(n.arrived)},  {"left", double(n.left)},  {"dropped", double(n.dropped)},
          {"queued", double(n.queued)},    {"oldest s", n.oldest_s},  {"QoI", n.qoi}};
      for (const auto &[key, number] : values)
      {
        diagnostic_msgs::msg::KeyValue pair;
        pair.key = key;
        pair.value = std::to_string(number);
        status.values.push_back(pair);
      }
      all.status.push_back(status);
    }
    diagnostics_->publish(all);
  }

  void stop()
  {
    for (rclcpp::TimerBase::SharedPtr *timer : {&start_, &look_, &tell_})
    {
      if (*timer)
        (*timer)->cancel();  // an executor that holds it does not call it
      timer->reset();
    }
    odometry_.reset();
    for (auto &[name, sending] : sendings_)
    {
      sending.subscription.reset();
      sending.sender->stop();
    }
    for (auto &[name, sending] : sendings_)
      sending.sender->close(0);
    sendings_.clear();
    motion_.reset();
  }

  const Policy *policy_ = nullptr;
  int capacity_ = 0;
  std::shared_ptr<Motion> motion_;
  std::map<std::string, Sending> sendings_;
  rclcpp::Subscription<nav_msgs::msg::Odometry>::SharedPtr odometry_;
  rclcpp_lifecycle::LifecyclePublisher<diagnostic_msgs::msg::DiagnosticArray>::SharedPtr diagnostics_;
  rclcpp::TimerBase::SharedPtr start_, look_, tell_;
  rclcpp::node_interfaces::OnSetParametersCallbackHandle::SharedPtr changes_;
};
}

std::shared_ptr<rclcpp_lifecycle::LifecycleNode> make_sender(const rclcpp::NodeOptions &options)
{
  return std::make_shared<bufgym::SenderNode>(options);
}

RCLCPP_COMPONENTS_REGISTER_NODE(bufgym::SenderNode)
