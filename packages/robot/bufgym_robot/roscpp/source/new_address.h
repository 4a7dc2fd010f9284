// A node of roscpp that registers anew once its machine has another address (robot/ros1/new_address.py).
//
// ROS 1's master tells subscribers the address that a node had when it registered. So nobody finds a robot that comes
// into another network, until its nodes are started again. A node whose address is announced by name (ROS_HOSTNAME) is
// left alone. The master must be reachable from the new address.
#ifndef BUFGYM_ROSCPP_NEW_ADDRESS_H
#define BUFGYM_ROSCPP_NEW_ADDRESS_H
#include <atomic>
#include <chrono>
#include <map>
#include <string>
#include <thread>
#include <vector>

#include <dlfcn.h>

#include <ros/connection_manager.h>
#include <ros/console.h>
#include <ros/init.h>
#include <ros/master.h>
#include <ros/network.h>
#include <ros/publication.h>
#include <ros/service_manager.h>
#include <ros/service_publication.h>
#include <ros/this_node.h>
#include <ros/topic_manager.h>
#include <ros/xmlrpc_manager.h>

#include "link.h"
#include "named.h"

namespace bufgym
{
NAMED(Uri, ros::XMLRPCManager, std::string, uri_)
NAMED(Services, ros::ServiceManager, ros::L_ServicePublication, service_publications_)

class Registration
{
public:
  // The address that roscpp announces: its own, or the one that this machine has by now.
  const std::string &host()
  {
    static const auto own = original();
    const std::string *now = moved_;
    return now ? *now : own();
  }

  void watch()
  {
    static const bool begun = (std::thread([this] { run(); }).detach(), true);
    (void)begun;
  }

private:
  typedef XmlRpc::XmlRpcValue Value;
  typedef const std::string &(*Host)();

  // roscpp's own getHost, which this library's stands before: whatever its name is to the linker, both have it.
  static Host original()
  {
    Dl_info about;
    return dladdr((void *)(Host)ros::network::getHost, &about) ? (Host)dlsym(RTLD_NEXT, about.dli_sname) : nullptr;
  }

  std::atomic<const std::string *> moved_{nullptr};

  void run()
  {
    while (!ros::isShuttingDown())
    {
      std::this_thread::sleep_for(std::chrono::milliseconds(500));
      if (!ros::isStarted() || ros::isShuttingDown())
        continue;
      const std::string old = host_in(ros::XMLRPCManager::instance()->getServerURI());
      const std::string now = is_gone(old) ? address_to(ros::master::getHost()) : "";
      if (!now.empty() && register_anew(old, now))
        ROS_WARN("bufgym: this machine's address has become %s; registered anew", now.c_str());
    }
  }

  // Whether the master has heard of it. All that is registered under the old URI is taken off first: a master that knows
  // one node by two URIs tells the one at the old address to end, and by now that may be another robot.
  bool register_anew(const std::string &old, const std::string &now)
  {
    end_connections_from(old);
    ros::XMLRPCManager &calls = *ros::XMLRPCManager::instance();
    const std::string uri = calls.getServerURI(), anew = "http://" + now + uri.substr(uri.rfind(':'));
    const std::string port = ":" + std::to_string(ros::ConnectionManager::instance()->getTCPPort());
    std::vector<std::string> published, subscribed, offered;
    ros::TopicManager::instance()->getAdvertisedTopics(published);
    ros::TopicManager::instance()->getSubscribedTopics(subscribed);
    for (const ros::ServicePublicationPtr &service : ros::ServiceManager::instance().get()->*pointer(Services()))
      offered.push_back(service->getName());
    Value types;
    bool heard = call("getTopicTypes", {}, types);
    std::map<std::string, std::string> kinds;
    for (int k = 0; heard && k < types.size(); k++)
      kinds[types[k][0]] = std::string(types[k][1]);

    for (const std::string &topic : published)
      heard = heard && call("unregisterPublisher", {topic, uri});
    for (const std::string &topic : subscribed)
      heard = heard && call("unregisterSubscriber", {topic, uri});
    for (const std::string &service : offered)
      heard = heard && call("unregisterService", {service, "rosrpc://" + old + port});
    if (!heard)
      return false;
    moved_ = new std::string(now);  // never freed: whoever asked before may still read the one before it
    for (const std::string &topic : published)
    {
      const ros::PublicationPtr publication = ros::TopicManager::instance()->lookupPublication(topic);
      heard = heard && (!publication || call("registerPublisher", {topic, publication->getDataType(), anew}));
    }
    for (const std::string &topic : subscribed)
      heard = heard && call("registerSubscriber", {topic, kinds.count(topic) ? kinds[topic] : "*", anew});
    for (const std::string &service : offered)
      heard = heard && call("registerService", {service, "rosrpc://" + now + port, anew});
    // At last: until then it is tried again. roscpp reads it, unlocked, where a topic or a service begins or ends.
    if (heard)
      calls.*pointer(Uri()) = anew;
    return heard;
  }

  static bool call(const std::string &method, const std::vector<std::string> &words)
  {
    Value payload;
    return call(method, words, payload);
  }

  static bool call(const std::string &method, const std::vector<std::string> &words, Value &payload)
  {
    Value request, response;
    request[0] = ros::this_node::getName();
    for (size_t k = 0; k < words.size(); k++)
      request[int(k) + 1] = words[k];
    return ros::master::execute(method, request, response, payload, false);
  }

  static std::string host_in(const std::string &uri)
  {
    std::string host;
    uint32_t port = 0;
    return ros::network::splitURI(uri, host, port) ? host : "";
  }
};
}
#endif
