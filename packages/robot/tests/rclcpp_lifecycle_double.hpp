// A double of rclcpp_lifecycle::LifecycleNode (see rclcpp_double.hpp).
#ifndef RCLCPP_LIFECYCLE_DOUBLE_HPP
#define RCLCPP_LIFECYCLE_DOUBLE_HPP
#include "rclcpp_double.hpp"

namespace rclcpp
{
namespace node_interfaces
{
struct NodeTopicsInterface
{
  using SharedPtr = std::shared_ptr<NodeTopicsInterface>;
  std::string space;
  std::string resolve_topic_name(const std::string &name, bool only_expand = false) const
  {
    (void)only_expand;
    if (name.empty() || name.find_first_of(" *'\"") != std::string::npos)
      throw std::runtime_error("Invalid topic name: " + name);
    return name[0] == '/' ? name : (space == "/" ? "" : space) + "/" + name;
  }
};
struct NodeParametersInterface
{
  using SharedPtr = std::shared_ptr<NodeParametersInterface>;
  std::map<std::string, ParameterValue> overrides;
  const std::map<std::string, ParameterValue> &get_parameter_overrides() const { return overrides; }
};
struct OnSetParametersCallbackHandle
{
  using SharedPtr = std::shared_ptr<OnSetParametersCallbackHandle>;
  std::function<rcl_interfaces::msg::SetParametersResult(const std::vector<Parameter> &)> call;
};
}

template <class Call, class Allocator = std::allocator<void>>
std::shared_ptr<GenericSubscription> create_generic_subscription(
    node_interfaces::NodeTopicsInterface::SharedPtr topics, const std::string &name, const std::string &type,
    const QoS &qos, Call &&call,
    const SubscriptionOptionsWithAllocator<Allocator> & = SubscriptionOptionsWithAllocator<Allocator>())
{
  const std::string resolved = topics->resolve_topic_name(name);
  if (type.find("/msg/") == std::string::npos)
    throw std::runtime_error("package of " + type + " not found");
  world.subscriptions.emplace_back(new GenericSubscription{resolved, type, qos, std::forward<Call>(call)});
  return world.subscriptions.back();
}
}

namespace rclcpp_lifecycle
{
class State
{
public:
  explicit State(uint8_t id) : id_(id) {}
  uint8_t id() const { return id_; }

private:
  uint8_t id_;
};

namespace node_interfaces
{
class LifecycleNodeInterface
{
public:
  enum class CallbackReturn : uint8_t { SUCCESS, FAILURE, ERROR };
  virtual CallbackReturn on_configure(const State &) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_cleanup(const State &) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_shutdown(const State &) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_activate(const State &) { return CallbackReturn::SUCCESS; }
  virtual CallbackReturn on_deactivate(const State &) { return CallbackReturn::SUCCESS; }
  virtual ~LifecycleNodeInterface() {}
};
}

template <class M>
class LifecyclePublisher
{
public:
  using SharedPtr = std::shared_ptr<LifecyclePublisher>;
  LifecyclePublisher(const std::string &topic, const bool &active) : topic_(topic), active_(active) {}
  void publish(const M &message)
  {
    if (active_)
      world.published[topic_].push_back(std::make_shared<M>(message));
  }

private:
  std::string topic_;
  const bool &active_;
};

class LifecycleNode : public node_interfaces::LifecycleNodeInterface
{
public:
  using SetParameters = std::function<rcl_interfaces::msg::SetParametersResult(const std::vector<rclcpp::Parameter> &)>;

  explicit LifecycleNode(const std::string &name, const rclcpp::NodeOptions &options = {}, bool services = true)
      : full_name_((options.space == "/" ? "" : options.space) + "/" + name), space_(options.space)
  {
    (void)services;
    topics_->space = space_;
    parameters_->overrides = options.overrides;
  }
  const char *get_namespace() const { return space_.c_str(); }
  const char *get_fully_qualified_name() const { return full_name_.c_str(); }
  rclcpp::Logger get_logger() const { return {}; }
  rclcpp::Clock::SharedPtr get_clock() { return std::make_shared<rclcpp::Clock>(); }
  rclcpp::Time now() const { return builtin_interfaces::msg::Time(); }
  rclcpp::node_interfaces::NodeTopicsInterface::SharedPtr get_node_topics_interface() { return topics_; }
  rclcpp::node_interfaces::NodeParametersInterface::SharedPtr get_node_parameters_interface() { return parameters_; }

  template <class T>
  T declare_parameter(
      const std::string &name, const T &at, const rcl_interfaces::msg::ParameterDescriptor &descriptor = {},
      bool ignore_override = false)
  {
    const auto given = parameters_->overrides.find(name);
    const bool over = !ignore_override && given != parameters_->overrides.end();
    const rclcpp::ParameterValue value = over ? given->second : rclcpp::ParameterValue(at);
    if (declared_.count(name) || !refusal(name, value, descriptor, rclcpp::ParameterValue(at)).empty())
      throw std::runtime_error("parameter " + name + " could not be set");
    declared_.emplace(name, Declared{value, descriptor});
    return at;
  }
  rclcpp::Parameter get_parameter(const std::string &name) const { return {name, declared_.at(name).value}; }
  // rclcpp::Node::set_parameter, which a parameter service calls.
  rcl_interfaces::msg::SetParametersResult set_parameter(const rclcpp::Parameter &parameter)
  {
    Declared &one = declared_.at(parameter.get_name());
    rcl_interfaces::msg::SetParametersResult result;
    const rclcpp::ParameterValue &value = parameter.get_parameter_value();
    result.reason = one.descriptor.read_only
                        ? "parameter '" + parameter.get_name() + "' cannot be set because it is read-only"
                        : refusal(parameter.get_name(), value, one.descriptor, one.value);
    result.successful = result.reason.empty();
    const auto handle = changes_.lock();
    if (result.successful && handle)
      result = handle->call({parameter});
    if (result.successful)
      one.value = value;
    return result;
  }
  [[nodiscard]] rclcpp::node_interfaces::OnSetParametersCallbackHandle::SharedPtr add_on_set_parameters_callback(
      SetParameters call)
  {
    const auto handle = std::make_shared<rclcpp::node_interfaces::OnSetParametersCallbackHandle>();
    handle->call = call;
    changes_ = handle;
    return handle;
  }

  template <class Rep, class Period, class Call>
  typename rclcpp::WallTimer<Call>::SharedPtr create_wall_timer(std::chrono::duration<Rep, Period> period, Call call)
  {
    auto timer = std::make_shared<rclcpp::WallTimer<Call>>();
    timer->period = period;
    timer->due = world.now + timer->period;
    timer->call = call;
    world.timers.push_back(timer);
    return timer;
  }
  template <class M>
  std::shared_ptr<LifecyclePublisher<M>> create_publisher(const std::string &topic, const rclcpp::QoS &)
  {
    return std::make_shared<LifecyclePublisher<M>>(topics_->resolve_topic_name(topic), active_);
  }
  template <class M, class Call>
  std::shared_ptr<rclcpp::Subscription<M>> create_subscription(
      const std::string &topic, const rclcpp::QoS &, Call &&call)
  {
    std::function<void(std::shared_ptr<const M>)> take = std::forward<Call>(call);
    const std::string name = topics_->resolve_topic_name(topic);
    world.typed[name] = [take](std::shared_ptr<const void> one) { take(std::static_pointer_cast<const M>(one)); };
    return std::make_shared<rclcpp::Subscription<M>>();
  }
  std::map<std::string, std::vector<std::string>> get_topic_names_and_types(bool no_demangle = false) const
  {
    (void)no_demangle;
    std::map<std::string, std::vector<std::string>> all;
    for (const auto &[topic, one] : world.publishers)
      all[topic] = {one.topic_type()};
    return all;
  }
  std::vector<rclcpp::TopicEndpointInfo> get_publishers_info_by_topic(const std::string &topic, bool = false) const
  {
    std::vector<rclcpp::TopicEndpointInfo> all;
    for (auto [one, end] = world.publishers.equal_range(topic); one != end; ++one)
      all.push_back(one->second);
    return all;
  }

  const State &get_current_state() const { return state_; }
  const State &configure() { return move(UNCONFIGURED, INACTIVE, &LifecycleNodeInterface::on_configure); }
  const State &cleanup() { return move(INACTIVE, UNCONFIGURED, &LifecycleNodeInterface::on_cleanup); }
  const State &activate() { return move(INACTIVE, ACTIVE, &LifecycleNodeInterface::on_activate); }
  const State &deactivate() { return move(ACTIVE, INACTIVE, &LifecycleNodeInterface::on_deactivate); }
  const State &shutdown() { return move(state_.id(), FINALIZED, &LifecycleNodeInterface::on_shutdown); }
  CallbackReturn on_activate(const State &) override { return active_ = true, CallbackReturn::SUCCESS; }
  CallbackReturn on_deactivate(const State &) override { return active_ = false, CallbackReturn::SUCCESS; }

private:
  using Msg = lifecycle_msgs::msg::State;
  static constexpr uint8_t UNCONFIGURED = Msg::PRIMARY_STATE_UNCONFIGURED, INACTIVE = Msg::PRIMARY_STATE_INACTIVE,
                           ACTIVE = Msg::PRIMARY_STATE_ACTIVE, FINALIZED = Msg::PRIMARY_STATE_FINALIZED;
  struct Declared
  {
    rclcpp::ParameterValue value;
    rcl_interfaces::msg::ParameterDescriptor descriptor;
  };

  // Why the value is none of the parameter; empty if it is one.
  static std::string refusal(
      const std::string &name, const rclcpp::ParameterValue &value,
      const rcl_interfaces::msg::ParameterDescriptor &descriptor, const rclcpp::ParameterValue &like)
  {
    if (value.get_type() != like.get_type())
      return "Wrong parameter type, parameter {" + name + "}";
    for (const auto &range : descriptor.integer_range)
      if (value.get<int64_t>() < range.from_value || value.get<int64_t>() > range.to_value)
        return "Parameter {" + name + "} doesn't comply with integer range.";
    return "";
  }
  const State &move(uint8_t from, uint8_t to, CallbackReturn (LifecycleNodeInterface::*through)(const State &))
  {
    if (state_.id() != from)
      return state_;
    const CallbackReturn done = (this->*through)(state_);
    if (done != CallbackReturn::FAILURE)
      state_ = State(done == CallbackReturn::SUCCESS ? to : FINALIZED);
    return state_;
  }

  std::string full_name_, space_;
  std::shared_ptr<rclcpp::node_interfaces::NodeTopicsInterface> topics_ =
      std::make_shared<rclcpp::node_interfaces::NodeTopicsInterface>();
  std::shared_ptr<rclcpp::node_interfaces::NodeParametersInterface> parameters_ =
      std::make_shared<rclcpp::node_interfaces::NodeParametersInterface>();
  std::map<std::string, Declared> declared_;
  std::weak_ptr<rclcpp::node_interfaces::OnSetParametersCallbackHandle> changes_;
  State state_{UNCONFIGURED};
  bool active_ = false;
};
}
#endif
