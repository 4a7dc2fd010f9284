// A double of what node.cpp uses of rclcpp 28.1 (ROS 2 Jazzy), rclcpp_lifecycle and rclcpp_components: the same names,
// types, constness and refusals, in one process and without DDS. The messages are the real ones. Where rclcpp itself is
// installed, test_ros2_node.py builds the node against it.
#ifndef RCLCPP_DOUBLE_HPP
#define RCLCPP_DOUBLE_HPP
#include <algorithm>
#include <array>
#include <chrono>
#include <cstdio>
#include <functional>
#include <map>
#include <memory>
#include <stdexcept>
#include <string>
#include <variant>
#include <vector>

#include <builtin_interfaces/msg/time.hpp>
#include <lifecycle_msgs/msg/state.hpp>
#include <rcl_interfaces/msg/parameter_descriptor.hpp>
#include <rcl_interfaces/msg/set_parameters_result.hpp>
#include <rmw/qos_profiles.h>
#include <rmw/types.h>

#define RCLCPP_INFO(logger, ...) \
  (static_cast<const rclcpp::Logger &>(logger), std::fprintf(stderr, __VA_ARGS__), std::fputc('\n', stderr))
#define RCLCPP_ERROR RCLCPP_INFO
#define RCLCPP_VERSION_GTE(major, minor, patch) (28 >= (major))
#define RCLCPP_ERROR_THROTTLE(logger, clock, ms, ...) \
  (static_cast<rclcpp::Clock &>(clock), RCLCPP_ERROR(logger, __VA_ARGS__))
#define RCLCPP_COMPONENTS_REGISTER_NODE(NodeClass)                                                \
  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> make_node(const rclcpp::NodeOptions &options) \
  {                                                                                              \
    return std::make_shared<NodeClass>(options);                                                 \
  }

namespace rclcpp
{
struct Logger {};
struct Clock
{
  using SharedPtr = std::shared_ptr<Clock>;
};

class Duration
{
public:
  explicit Duration(std::chrono::nanoseconds length) : ns_(length.count()) {}
  static Duration from_nanoseconds(int64_t ns) { return Duration(std::chrono::nanoseconds(ns)); }
  static Duration from_rmw_time(rmw_time_t time)
  {
    return from_nanoseconds(int64_t(time.sec * 1000000000 + time.nsec));
  }
  int64_t nanoseconds() const { return ns_; }
  rmw_time_t to_rmw_time() const { return {uint64_t(ns_ / 1000000000), uint64_t(ns_ % 1000000000)}; }

private:
  int64_t ns_;
};

class Time
{
public:
  Time(const builtin_interfaces::msg::Time &stamp) : stamp_(stamp) {}
  double seconds() const { return stamp_.sec + 1e-9 * stamp_.nanosec; }
  operator builtin_interfaces::msg::Time() const { return stamp_; }

private:
  builtin_interfaces::msg::Time stamp_;
};

enum class ReliabilityPolicy
{
  BestEffort = RMW_QOS_POLICY_RELIABILITY_BEST_EFFORT,
  Reliable = RMW_QOS_POLICY_RELIABILITY_RELIABLE
};
enum class DurabilityPolicy
{
  Volatile = RMW_QOS_POLICY_DURABILITY_VOLATILE,
  TransientLocal = RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL
};
enum class LivelinessPolicy
{
  Automatic = RMW_QOS_POLICY_LIVELINESS_AUTOMATIC,
  ManualByTopic = RMW_QOS_POLICY_LIVELINESS_MANUAL_BY_TOPIC
};

struct QoSInitialization
{
  rmw_qos_history_policy_t history_policy;
  size_t depth;
};
struct KeepLast : QoSInitialization
{
  explicit KeepLast(size_t depth) : QoSInitialization{RMW_QOS_POLICY_HISTORY_KEEP_LAST, depth} {}
};

class QoS
{
public:
  explicit QoS(const QoSInitialization &start, const rmw_qos_profile_t &profile = rmw_qos_profile_default)
      : rmw_(profile)
  {
    rmw_.history = start.history_policy;
    rmw_.depth = start.depth;
  }
  QoS(size_t depth) : QoS(KeepLast(depth)) {}
  rmw_qos_profile_t &get_rmw_qos_profile() { return rmw_; }
  const rmw_qos_profile_t &get_rmw_qos_profile() const { return rmw_; }
  QoS &keep_last(size_t depth) { return rmw_.depth = depth, *this; }
  QoS &reliability(rmw_qos_reliability_policy_t policy) { return rmw_.reliability = policy, *this; }
  QoS &reliability(ReliabilityPolicy policy) { return reliability(rmw_qos_reliability_policy_t(policy)); }
  QoS &durability(DurabilityPolicy policy) { return rmw_.durability = rmw_qos_durability_policy_t(policy), *this; }
  QoS &liveliness(LivelinessPolicy policy) { return rmw_.liveliness = rmw_qos_liveliness_policy_t(policy), *this; }
  QoS &deadline(const Duration &length) { return rmw_.deadline = length.to_rmw_time(), *this; }
  QoS &lifespan(const Duration &length) { return rmw_.lifespan = length.to_rmw_time(), *this; }
  QoS &liveliness_lease_duration(const Duration &length)
  {
    return rmw_.liveliness_lease_duration = length.to_rmw_time(), *this;
  }
  ReliabilityPolicy reliability() const { return ReliabilityPolicy(rmw_.reliability); }
  DurabilityPolicy durability() const { return DurabilityPolicy(rmw_.durability); }
  LivelinessPolicy liveliness() const { return LivelinessPolicy(rmw_.liveliness); }
  size_t depth() const { return rmw_.depth; }
  Duration deadline() const { return Duration::from_rmw_time(rmw_.deadline); }
  Duration lifespan() const { return Duration::from_rmw_time(rmw_.lifespan); }
  Duration liveliness_lease_duration() const { return Duration::from_rmw_time(rmw_.liveliness_lease_duration); }

private:
  rmw_qos_profile_t rmw_;
};
struct SensorDataQoS : QoS
{
  SensorDataQoS() : QoS(KeepLast(5), rmw_qos_profile_sensor_data) {}
};

class ParameterValue
{
public:
  using Any = std::variant<bool, int64_t, std::string, std::vector<std::string>>;
  explicit ParameterValue(bool value) : any_(value) {}
  explicit ParameterValue(int value) : any_(int64_t(value)) {}
  explicit ParameterValue(int64_t value) : any_(value) {}
  explicit ParameterValue(const std::string &value) : any_(value) {}
  explicit ParameterValue(const std::vector<std::string> &value) : any_(value) {}
  size_t get_type() const { return any_.index(); }
  template <class T>
  const T &get() const
  {
    if (const T *value = std::get_if<T>(&any_))
      return *value;
    throw std::runtime_error("expected another type of parameter");
  }

private:
  Any any_;
};

class Parameter
{
public:
  Parameter(const std::string &name, const ParameterValue &value) : name_(name), value_(value) {}
  const std::string &get_name() const { return name_; }
  const ParameterValue &get_parameter_value() const { return value_; }
  bool as_bool() const { return value_.get<bool>(); }
  int64_t as_int() const { return value_.get<int64_t>(); }
  const std::string &as_string() const { return value_.get<std::string>(); }
  const std::vector<std::string> &as_string_array() const { return value_.get<std::vector<std::string>>(); }

private:
  std::string name_;
  ParameterValue value_;
};

enum class QosPolicyKind { Depth, Reliability };
inline const char *qos_policy_kind_to_cstr(const QosPolicyKind &kind)
{
  return kind == QosPolicyKind::Depth ? "depth" : "reliability";
}
namespace detail
{
struct SubscriptionQosParametersTraits
{
  static constexpr auto allowed_policies()
  {
    return std::array<QosPolicyKind, 2>{QosPolicyKind::Depth, QosPolicyKind::Reliability};
  }
};
inline void apply_qos_override(QosPolicyKind kind, ParameterValue value, QoS &qos)
{
  if (kind == QosPolicyKind::Depth)
    qos.get_rmw_qos_profile().depth = size_t(value.get<int64_t>());
  else if (value.get<std::string>() == "best_effort")
    qos.reliability(ReliabilityPolicy::BestEffort);
  else if (value.get<std::string>() == "reliable")
    qos.reliability(ReliabilityPolicy::Reliable);
  else
    throw std::invalid_argument("unknown QoS policy reliability value: " + value.get<std::string>());
}
}

struct NodeOptions
{
  std::string space;
  std::map<std::string, ParameterValue> overrides;
};

class SerializedMessage
{
public:
  explicit SerializedMessage(std::vector<uint8_t> bytes)
      : bytes_(std::move(bytes)), rcl_{bytes_.data(), bytes_.size(), bytes_.size(), {}}
  {
  }
  const rmw_serialized_message_t &get_rcl_serialized_message() const { return rcl_; }

private:
  std::vector<uint8_t> bytes_;
  rmw_serialized_message_t rcl_;
};

template <class Allocator>
struct SubscriptionOptionsWithAllocator {};
using SubscriptionOptions = SubscriptionOptionsWithAllocator<std::allocator<void>>;

class MessageInfo
{
public:
  explicit MessageInfo(const rmw_message_info_t &rmw) : rmw_(rmw) {}
  const rmw_message_info_t &get_rmw_message_info() const { return rmw_; }

private:
  rmw_message_info_t rmw_;
};

struct GenericSubscription
{
  using SharedPtr = std::shared_ptr<GenericSubscription>;
  std::string topic, type;
  QoS qos;
  std::function<void(std::shared_ptr<const SerializedMessage>, const MessageInfo &)> call;
};
template <class M>
struct Subscription
{
  using SharedPtr = std::shared_ptr<Subscription>;
  std::string topic;
  std::function<void(std::shared_ptr<const M>)> call;
};

struct TimerBase
{
  using SharedPtr = std::shared_ptr<TimerBase>;
  std::chrono::nanoseconds period, due;
  std::function<void()> call;
  bool cancelled = false;
  void cancel() { cancelled = true; }
};
template <class Call>
struct WallTimer : TimerBase
{
  using SharedPtr = std::shared_ptr<WallTimer>;
};

class TopicEndpointInfo
{
public:
  TopicEndpointInfo(const std::string &node, const std::string &type, const QoS &qos)
      : node_(node), type_(type), qos_(qos)
  {
    std::copy_n(node.data(), std::min(node.size(), gid_.size()), gid_.begin());
  }
  std::array<uint8_t, RMW_GID_STORAGE_SIZE> &endpoint_gid() { return gid_; }
  const std::array<uint8_t, RMW_GID_STORAGE_SIZE> &endpoint_gid() const { return gid_; }
  const std::string &node_name() const { return node_; }
  const std::string &topic_type() const { return type_; }
  QoS &qos_profile() { return qos_; }
  const QoS &qos_profile() const { return qos_; }

private:
  std::string node_, type_;
  QoS qos_;
  std::array<uint8_t, RMW_GID_STORAGE_SIZE> gid_{};
};
}

// Publishers, subscriptions and timers, all of which an executor still holds when their owners have let them go.
struct World
{
  std::multimap<std::string, rclcpp::TopicEndpointInfo> publishers;
  std::vector<rclcpp::GenericSubscription::SharedPtr> subscriptions;
  std::vector<rclcpp::TimerBase::SharedPtr> timers;
  std::map<std::string, std::vector<std::shared_ptr<const void>>> published;
  std::map<std::string, std::function<void(std::shared_ptr<const void>)>> typed;
  std::chrono::nanoseconds now{0};
};
inline World world;
#endif
