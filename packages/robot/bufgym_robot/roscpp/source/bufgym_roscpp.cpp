// libbufgym_roscpp.so: queues of roscpp's publishers under policies of bufgym, the node unchanged.
//
//   LD_PRELOAD=libbufgym_roscpp.so BUFGYM_POLICY=learned rosrun ...      (settings.h has all settings)
//
// It takes the place of functions that libroscpp exports: of ros::TransportSubscriberLink enqueueMessage,
// startMessageWrite and onMessageWritten, and of ros::network::getHost. Calls to them go through vtable, PLT and GOT, so
// the library that is loaded first has them. roscpp's class is the same from indigo to noetic (transport_subscriber_link.h of ros_comm at
// indigo-devel, kinetic-devel, melodic-devel and noetic-devel); its Boost headers must be the robot's own.
#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstring>
#include <deque>
#include <memory>
#include <thread>
#include <unordered_map>

#include <linux/sockios.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/ioctl.h>
#include <sys/socket.h>

#include <nav_msgs/Odometry.h>
#include <ros/callback_queue.h>
#include <ros/connection.h>
#include <ros/init.h>
#include <ros/publication.h>
#include <ros/subscribe_options.h>
#include <ros/topic_manager.h>
#include <ros/transport/transport_tcp.h>
#define private public  // the functions below are members of the class and use its members
#include <ros/transport_subscriber_link.h>
#undef private

#ifndef TCP_NOTSENT_LOWAT  // Linux has it since 3.12, and some older C libraries do not name it
#define TCP_NOTSENT_LOWAT 25
#endif

#include "link.h"
#include "log.h"
#include "motion.h"
#include "named.h"
#include "new_address.h"
#include "policy.h"
#include "settings.h"

namespace bufgym
{
NAMED(Socket, ros::TransportTCP, int, sock_)
NAMED(Written, ros::Connection, uint32_t, write_sent_)
NAMED(ToWrite, ros::Connection, uint32_t, write_size_)
NAMED(Ending, ros::TopicManager, boost::mutex, shutting_down_mutex_)
}

namespace
{
const int DEAD_MS = 900000;  // the subscriber alone can connect again, and is not told, so a connection stays for 15 min
const int UNSENT_BYTES = 16384;  // the system wants more when less than this is unsent, whatever is in flight

const bufgym::Settings &settings()
{
  static const bufgym::Settings *all = new bufgym::Settings;  // outlives every thread, as all that is static here
  return *all;
}

// x by a topic, on a queue and a thread of its own: the node need not spin. The thread also subscribes, because who asks
// for x holds locks that roscpp takes the other way round when it subscribes. It has no NodeHandle and no spinner: the
// node still ends with its own last handle, and old roscpp has one spinner in a process.
struct Odometry
{
  bufgym::Motion motion;
  ros::CallbackQueue callbacks;
  std::atomic<bool> refused{false};  // then x counts messages

  explicit Odometry(const std::string &topic) { std::thread(&Odometry::run, this, topic).detach(); }

  void run(const std::string &topic)
  {
    ros::SubscribeOptions options;
    options.init<nav_msgs::Odometry>(topic, 100, [this](const nav_msgs::Odometry::ConstPtr &message) { take(message); });
    options.callback_queue = &callbacks;
    try
    {
      const ros::TopicManagerPtr &topics = ros::TopicManager::instance();
      // The node's end waits meanwhile: before noetic it takes subscribe's two locks the other way round.
      boost::mutex::scoped_lock lock(topics.get()->*pointer(bufgym::Ending()));
      refused = ros::isShuttingDown() || !topics->subscribe(options);
    }
    catch (const ros::Exception &error)  // the node itself has the topic with another type
    {
      refused = true;
    }
    if (refused && !ros::isShuttingDown())
      ROS_ERROR("bufgym: %s: must be a topic of nav_msgs/Odometry: x counts messages", topic.c_str());
    while (ros::ok() && !refused)
      callbacks.callAvailable(ros::WallDuration(0.1));
  }

  void take(const nav_msgs::Odometry::ConstPtr &message)
  {
    const auto &p = message->pose.pose.position;
    const auto &o = message->pose.pose.orientation;
    motion.take(message->header.frame_id, message->header.stamp.toSec(), {p.x, p.y, p.z}, {o.x, o.y, o.z, o.w});
  }
};

bufgym::Registration &registration()
{
  static auto *all = new bufgym::Registration;
  return *all;
}

bufgym::Motion *motion()
{
  static auto *all = settings().odometry.empty() ? nullptr : new Odometry(settings().odometry);
  return all && !all->refused ? &all->motion : nullptr;
}

// What a subscriber's link has besides roscpp's own members, under its outbox_mutex_: roscpp's poll thread uses it, and a
// thread of the node's that publishes to one new subscriber.
struct State
{
  boost::weak_ptr<ros::SubscriberLink> link;
  std::unique_ptr<bufgym::Queue> queue;  // null where roscpp's own rule stays
  bufgym::Log log;
  int socket = -1;
  int64_t first_us = 0, last_us = 0;  // when it began, and its last event
  int64_t arrived = 0, dequeued_bytes = 0, carried = 0, seq = -1, in_socket = 0;

  int64_t stamp() { return last_us = std::max(last_us + 1, bufgym::now_us() - first_us); }
};

std::unordered_map<void *, std::unique_ptr<State>> &states()
{
  static auto *all = new std::unordered_map<void *, std::unique_ptr<State>>;
  return *all;
}

boost::mutex &states_mutex()
{
  static auto *mutex = new boost::mutex;
  return *mutex;
}

struct Box : std::queue<ros::SerializedMessage>
{
  using queue::c;
};

bool is_local(int socket)
{
  sockaddr_storage here, there;
  socklen_t size = sizeof here, other = sizeof there;
  if (getsockname(socket, (sockaddr *)&here, &size) || getpeername(socket, (sockaddr *)&there, &other))
    return false;
  if (here.ss_family == AF_INET)
    return ((sockaddr_in *)&here)->sin_addr.s_addr == ((sockaddr_in *)&there)->sin_addr.s_addr;
  return !memcmp(&((sockaddr_in6 *)&here)->sin6_addr, &((sockaddr_in6 *)&there)->sin6_addr, sizeof(in6_addr));
}

int capacity_of(const ros::PublicationWPtr &publication)
{
  const ros::PublicationPtr parent = publication.lock();
  return parent ? (int)parent->getMaxQueue() : 0;
}

void begin(State &state, ros::TransportSubscriberLink *link, int capacity)
{
  const std::string topic = link->getTopic();
  const bufgym::Policy *policy = settings().of(topic);
  auto *tcp = dynamic_cast<ros::TransportTCP *>(link->getConnection()->getTransport().get());
  if (settings().capacity > 0 && capacity > 0)
    capacity = settings().capacity;
  if (!policy || !tcp || capacity < 1)
    return;
  if (capacity > bufgym::MOST)
  {
    ROS_WARN("bufgym: %s: queue_size %d is over %d: roscpp's own queue stays", topic.c_str(), capacity, bufgym::MOST);
    return;
  }
  state.socket = tcp->*pointer(bufgym::Socket());
  if (!settings().local && is_local(state.socket))
    return;
  state.first_us = bufgym::now_us();
  state.queue = policy->make(0, capacity);
  if (!settings().log.empty())
    state.log.open(settings().log, topic, *policy, capacity);
  tcp->setNoDelay(true);
  setsockopt(state.socket, IPPROTO_TCP, TCP_NOTSENT_LOWAT, &UNSENT_BYTES, sizeof UNSENT_BYTES);
  bufgym::bounded_backoff(state.socket, 1000 * settings().backoff_s, DEAD_MS);
}

State &state_of(ros::TransportSubscriberLink *link, const ros::PublicationWPtr &publication)
{
  boost::mutex::scoped_lock lock(states_mutex());
  std::unique_ptr<State> &state = states()[link];
  if (state && state->link.lock().get() == link)
    return *state;
  state.reset(new State);  // a new link, perhaps at an old one's address
  state->link = link->shared_from_this();
  begin(*state, link, capacity_of(publication));
  State &made = *state;
  for (auto i = states().begin(); i != states().end();)
    i = i->second->link.expired() ? states().erase(i) : std::next(i);
  return made;
}

// Bytes that the link has carried so far, by what the system says is unsent.
int64_t carried(State &state, const ros::Connection &connection)
{
  if (state.in_socket == 0)
    return state.carried;
  int unsent = 0;
  ioctl(state.socket, SIOCOUTQNSD, &unsent);
  const int64_t left = unsent + int64_t(connection.*pointer(bufgym::ToWrite()) - connection.*pointer(bufgym::Written()));
  state.carried = std::max(state.carried, std::min(state.dequeued_bytes - 1, state.dequeued_bytes - left));
  return state.carried;
}

// Ask the policy, and carry its decision out on roscpp's queue; whether the message stays.
bool keeps(State &state, std::deque<ros::SerializedMessage> &box, int64_t size_bytes, const ros::Connection &connection)
{
  const int64_t us = state.stamp(), seq = state.arrived++, position = carried(state, connection);
  bufgym::Motion *moved = motion();  // asked once: its thread may refuse the topic at any time
  const double x = moved ? moved->x() : double(seq);
  const auto begun = std::chrono::steady_clock::now();
  const int decision = state.queue->arrival(us, size_bytes, x, state.dequeued_bytes - position);
  const std::chrono::duration<double, std::micro> took = std::chrono::steady_clock::now() - begun;
  state.log.put(us, seq, size_bytes, x, position, took.count());
  if (decision >= 0)
    box.erase(box.begin() + decision);
  if (decision != bufgym::ACCEPT)
    state.log.event("dropped", us, state.queue->dropped());
  return decision != bufgym::REJECT;
}
}

namespace ros
{
// roscpp asks when its node starts, and whenever it tells somebody where to connect to.
const std::string &network::getHost()
{
  registration().watch();
  return registration().host();
}

void TransportSubscriberLink::enqueueMessage(const SerializedMessage &m, bool ser, bool)
{
  if (!ser)
    return;
  {
    boost::mutex::scoped_lock lock(outbox_mutex_);
    State &state = state_of(this, parent_);
    std::deque<SerializedMessage> &box = static_cast<Box &>(outbox_).c;
    if (state.queue)
    {
      if (!keeps(state, box, m.num_bytes, *connection_))
        return;
    }
    else
    {
      const int capacity = capacity_of(parent_);  // roscpp takes one below 1, as a queue_size of -1, for no bound
      if (capacity > 0 && (int)box.size() >= capacity)
        box.pop_front();
    }
    box.push_back(m);
  }
  startMessageWrite(false);
  stats_.messages_sent_++;
  stats_.bytes_sent_ += m.num_bytes;
  stats_.message_data_sent_ += m.num_bytes;
}

void TransportSubscriberLink::startMessageWrite(bool immediate_write)
{
  SerializedMessage m(boost::shared_array<uint8_t>(), 0);
  {
    boost::mutex::scoped_lock lock(outbox_mutex_);
    if (writing_message_ || !header_written_ || outbox_.empty())
      return;
    State &state = state_of(this, parent_);
    writing_message_ = true;
    m = outbox_.front();
    outbox_.pop();
    if (state.queue)
    {
      state.seq = state.queue->dequeue(state.last_us);
      state.in_socket = m.num_bytes;
      state.dequeued_bytes += m.num_bytes;
      state.log.event("dequeued", state.last_us, state.seq);
    }
  }
  const auto written = [this](const ConnectionPtr &connection) { onMessageWritten(connection); };
  connection_->write(m.buf, m.num_bytes, written, immediate_write);
}

void TransportSubscriberLink::onMessageWritten(const ConnectionPtr &)
{
  bool ruled = false;
  {
    boost::mutex::scoped_lock lock(outbox_mutex_);
    State &state = state_of(this, parent_);
    if (state.queue && state.in_socket > 0)
    {
      ruled = true;
      const int64_t us = state.stamp();
      state.queue->sent(us, state.in_socket);
      state.carried = state.dequeued_bytes;
      state.log.gone(us, state.seq, state.carried);
      state.in_socket = 0;
    }
    writing_message_ = false;
  }
  startMessageWrite(!ruled);  // under a policy the next one waits for POLLOUT, which TCP_NOTSENT_LOWAT holds back
}
}
