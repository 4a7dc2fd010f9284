// What the user set: environment variables, or private parameters of the node (~bufgym_policy for BUFGYM_POLICY).
//
//   BUFGYM_POLICY      policy of all topics (learned); none: roscpp's own queue
//   BUFGYM_TOPICS      policies of single topics, as /scan=drop-oldest,/map=none
//   BUFGYM_VALUE       V (exponential:0.618 over messages, exponential:0.36787944 over motion)
//   BUFGYM_QUEUE_SIZE  L (the publisher's queue_size)
//   BUFGYM_ODOMETRY    topic of nav_msgs/Odometry from which x is summed (x counts messages)
//   BUFGYM_BACKOFF_S   longest time between two tries of TCP at a dead link, 1 to 120 s (1; Linux from 6.15 on)
//   BUFGYM_LOCAL       1: also for subscribers on this machine
//   BUFGYM_LOG         folder for a log of each queue, which `bufgym live replay` reads
#ifndef BUFGYM_ROSCPP_SETTINGS_H
#define BUFGYM_ROSCPP_SETTINGS_H
#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <map>
#include <sstream>
#include <string>

#include <ros/console.h>
#include <ros/exception.h>
#include <ros/names.h>
#include <ros/param.h>

#include "log.h"
#include "policy.h"

namespace bufgym
{
struct Settings
{
  const Policy *policy = nullptr;
  std::map<std::string, const Policy *> topics;
  int capacity = 0, backoff_s = 1;
  bool local = false;
  std::string odometry, log;

  // The policy of a topic; null where roscpp's own queue stays.
  const Policy *of(const std::string &topic) const
  {
    const auto own = topics.find(topic);
    return own == topics.end() ? policy : own->second;
  }

  Settings()
  {
    for (const char *small : {"/rosout", "/rosout_agg", "/tf", "/tf_static", "/clock"})  // every node reads them
      topics[small] = nullptr;
    policy = named(text("POLICY", "learned"));
    std::istringstream pairs(text("TOPICS", ""));
    for (std::string pair; std::getline(pairs, pair, ',');)
    {
      const size_t equals = pair.find('=');
      if (equals == std::string::npos || pair[0] != '/')
        ROS_ERROR("bufgym: BUFGYM_TOPICS: %s: must be /TOPIC=POLICY", pair.c_str());
      else
        topics[pair.substr(0, equals)] = named(pair.substr(equals + 1));
    }
    const std::string size = text("QUEUE_SIZE", ""), here = text("LOCAL", "0");
    capacity = std::atoi(size.c_str());
    if (!size.empty() && (size != std::to_string(capacity) || capacity < 1 || capacity > MOST))
    {
      ROS_ERROR("bufgym: L = %s: must be 1 to %d; it is the publisher's queue_size", size.c_str(), MOST);
      capacity = 0;
    }
    const std::string backoff = text("BACKOFF_S", "1");
    backoff_s = std::atoi(backoff.c_str());
    if (backoff != std::to_string(backoff_s) || backoff_s < 1 || backoff_s > 120)
    {
      ROS_ERROR("bufgym: BUFGYM_BACKOFF_S = %s: must be 1 to 120; it is 1", backoff.c_str());
      backoff_s = 1;
    }
    local = here == "1" || here == "true";
    if (!local && here != "0" && here != "false")
      ROS_ERROR("bufgym: BUFGYM_LOCAL = %s: must be 0 or 1; it is 0", here.c_str());
    odometry = text("ODOMETRY", "");
    try
    {
      odometry = odometry.empty() ? odometry : ros::names::resolve(odometry);
    }
    catch (const ros::Exception &error)
    {
      ROS_ERROR("bufgym: odometry: %s: x counts messages", error.what());
      odometry.clear();
    }
    log = text("LOG", "");
    if (!log.empty() && !Log::writable(log))
      ROS_ERROR("bufgym: no log: %s: %s", log.c_str(), std::strerror(errno));
    const std::string wanted = text("VALUE", odometry.empty() ? v.name : "exponential:0.36787944117144233");
    if (!set_value(wanted))
      ROS_ERROR("bufgym: V = %s: must be exponential:BASE or saturating:DISTANCE; it is %s", wanted.c_str(), v.name.c_str());
  }

private:
  static std::string text(const std::string &name, const std::string &otherwise)
  {
    const char *word = std::getenv(("BUFGYM_" + name).c_str());
    if (word)
      return word;
    std::string key = "~bufgym_";
    for (char c : name)
      key += c == '_' ? c : char(c + 32);
    XmlRpc::XmlRpcValue value;  // roslaunch makes numbers of what looks like them
    std::ostringstream written;
    return ros::param::get(key, value) ? (written << value, written.str()) : otherwise;
  }

  static const Policy *named(const std::string &name)
  {
    const Policy *found = name == "none" ? nullptr : find(name);
    if (!found && name != "none")
      ROS_ERROR("bufgym: unknown policy %s: roscpp's own queue stays; known: none, %s", name.c_str(), known().c_str());
    return found;
  }
};
}
#endif
