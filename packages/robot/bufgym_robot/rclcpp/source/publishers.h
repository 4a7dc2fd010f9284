// The quality of service that a topic's publishers offer, and that of a subscription which gets them all.
#ifndef BUFGYM_SENDER_PUBLISHERS_H
#define BUFGYM_SENDER_PUBLISHERS_H
#include <algorithm>
#include <chrono>
#include <memory>
#include <set>
#include <string>

#include <rclcpp/detail/qos_parameters.hpp>
#include <rclcpp/rclcpp.hpp>
#include <rclcpp/version.h>
#include <rclcpp_lifecycle/lifecycle_node.hpp>

#include "frames.h"

namespace bufgym
{
using Node = rclcpp_lifecycle::LifecycleNode;

// In the node's name of a receiver. No topic that a receiver publishes is sent, so that two pairs make no circle.
const char *const RECEIVER = "bufgym_receive";
const size_t LATCHED_DEPTH = 1000;  // messages of a latched topic that wait to be taken: more than it has publishers
const int64_t LONGEST_NS = INT64_C(1) << 62;

// A publisher's number, made from its id in DDS (FNV-1a).
template <class Gid>
uint64_t source_of(const Gid &gid)
{
  uint64_t number = UINT64_C(14695981039346656037);
  for (const uint8_t byte : gid)
    number = (number ^ byte) * UINT64_C(1099511628211);
  return number;
}

// Make a subscription's callback that calls take(data, publisher's number, time of the publication in us).
#if RCLCPP_VERSION_GTE(25, 0, 0)
const bool TELLS_PUBLISHER = true;
template <class Take>
auto with_publisher(Take take)
{
  return [take](std::shared_ptr<const rclcpp::SerializedMessage> message, const rclcpp::MessageInfo &info) {
    const rmw_message_info_t &about = info.get_rmw_message_info();
    take(message->get_rcl_serialized_message(), source_of(about.publisher_gid.data), about.source_timestamp / 1000);
  };
}
#else
const bool TELLS_PUBLISHER = false;
template <class Take>
auto with_publisher(Take take)
{
  return [take](std::shared_ptr<const rclcpp::SerializedMessage> message) {
    take(message->get_rcl_serialized_message(), uint64_t(0), int64_t(0));
  };
}
#endif

// Say why sending the topic would send its copies again, too: a receiver publishes it beside others. Empty if not.
inline std::string circle(const Node &node, const std::string &name)
{
  std::string again;
  bool others = false;
  for (const rclcpp::TopicEndpointInfo &one : node.get_publishers_info_by_topic(name))
    if (one.node_name().find(RECEIVER) == std::string::npos)
      others = true;
    else
      again = one.node_name();
  if (again.empty() || !others)
    return "";
  return again + " publishes it in this domain, too, and its copies would be sent again: give " + again +
         " another ROS_DOMAIN_ID, or start it with --ros-args -r " + name + ":=/base" + name;
}

// Describe the topic by the weakest promise of any of its publishers, and name these; false if there is none.
inline bool published(
    const Node &node, const std::string &name, const std::string &type, Published &topic, std::set<uint64_t> &living)
{
  topic.name = name;
  topic.type = type;
  topic.transient_local = topic.manual = true;
  topic.depth = 0;
  bool any = false;
  for (const rclcpp::TopicEndpointInfo &one : node.get_publishers_info_by_topic(name))
  {
    if (one.node_name().find(RECEIVER) != std::string::npos)
      continue;
    const rclcpp::QoS &qos = one.qos_profile();
    any = true;
    living.insert(source_of(one.endpoint_gid()));
    topic.reliable &= qos.reliability() == rclcpp::ReliabilityPolicy::Reliable;
    topic.transient_local &= qos.durability() == rclcpp::DurabilityPolicy::TransientLocal;
    topic.manual &= qos.liveliness() == rclcpp::LivelinessPolicy::ManualByTopic;
    topic.depth = std::max(topic.depth, uint16_t(std::min<size_t>(qos.depth(), UINT16_MAX)));
    topic.deadline_ns = std::max(topic.deadline_ns, int64_t(qos.deadline().nanoseconds()));
    topic.lifespan_ns = std::max(topic.lifespan_ns, int64_t(qos.lifespan().nanoseconds()));
    topic.lease_ns = std::max(topic.lease_ns, int64_t(qos.liveliness_lease_duration().nanoseconds()));
  }
  for (int64_t *ns : {&topic.deadline_ns, &topic.lifespan_ns, &topic.lease_ns})
    *ns = *ns < LONGEST_NS ? *ns : 0;
  topic.depth = latched(topic) ? uint16_t(living.size()) : topic.depth ? topic.depth : 10;  // DDS does not announce it
  return any;
}

// A subscription's quality of service, with the user's qos_overrides: rclcpp reads them for known types alone.
inline rclcpp::QoS subscription_qos(Node &node, const Published &topic, int capacity)
{
  const size_t waiting = latched(topic) ? LATCHED_DEPTH : size_t(capacity);
  rclcpp::QoS qos{rclcpp::KeepLast(std::max<size_t>(waiting, topic.depth))};
  qos.reliability(topic.reliable ? rclcpp::ReliabilityPolicy::Reliable : rclcpp::ReliabilityPolicy::BestEffort);
  qos.durability(
      topic.transient_local ? rclcpp::DurabilityPolicy::TransientLocal : rclcpp::DurabilityPolicy::Volatile);
  qos.liveliness(topic.manual ? rclcpp::LivelinessPolicy::ManualByTopic : rclcpp::LivelinessPolicy::Automatic);
  if (topic.deadline_ns)
    qos.deadline(rclcpp::Duration(std::chrono::nanoseconds(topic.deadline_ns)));
  if (topic.lease_ns)
    qos.liveliness_lease_duration(rclcpp::Duration(std::chrono::nanoseconds(topic.lease_ns)));
  const auto &given = node.get_node_parameters_interface()->get_parameter_overrides();
  for (const rclcpp::QosPolicyKind kind : rclcpp::detail::SubscriptionQosParametersTraits::allowed_policies())
  {
    const std::string prefix = "qos_overrides." + topic.name + ".subscription.";
    const auto one = given.find(prefix + rclcpp::qos_policy_kind_to_cstr(kind));
    if (one != given.end())
      rclcpp::detail::apply_qos_override(kind, one->second, qos);
  }
  return qos;
}
}
#endif
