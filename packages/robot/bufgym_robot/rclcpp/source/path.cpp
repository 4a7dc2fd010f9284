// A sender's connections: made, watched and raced.
#include "path.h"

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cstdio>
#include <cstring>
#include <memory>

#include <linux/sockios.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

#include "link.h"
#include "policy.h"

namespace bufgym
{
namespace
{
const int UNSENT_BYTES = 16384;   // the system wants more when less than this is unsent, whatever is in flight
const int DEAD_MS = 20000;        // a connection without acks for so long is given up
const int SOONER_DEAD_MS = 5000;  // where the kernel cannot bound its backoff: a new connection is soon
const int BACKOFF_MS = 1000;      // longest time between two tries of TCP at a dead link
const int CONNECT_MS = 3000;      // TCP asks again after 1 and 3 s
const int NEXT_ADDRESS_MS = 1000; // before another of the host's addresses is tried
const int64_t PING_US = 1000000;  // without a sign of life, before one is asked for
const int64_t SILENT_US = 2000000;  // without a sign of life, before a second connection is tried
const int64_t AGAIN_US = 500000;  // between two tries of a second connection
const int SMALLER_BYTES[] = {1200, 576};  // packets for a path that does not take full ones
const int MOST_HEADER_BYTES = 72; // of IPv6 and of TCP with timestamps

void set(int socket, int option, int number) { setsockopt(socket, IPPROTO_TCP, option, &number, sizeof number); }

int segment_bytes(int family, int packet_bytes) { return packet_bytes - (family == AF_INET6 ? 60 : 40); }

// Connect to the first of the host's addresses that answers.
int connected_to(const Address &to, int packet_bytes)
{
  addrinfo hints = {}, *found = nullptr;
  hints.ai_socktype = SOCK_STREAM;
  if (const int error = getaddrinfo(to.host.c_str(), std::to_string(to.port).c_str(), &hints, &found))
    throw Fault(to.host + ": " + gai_strerror(error));
  const std::unique_ptr<addrinfo, void (*)(addrinfo *)> all(found, freeaddrinfo);
  int error = ECONNREFUSED;
  for (const addrinfo *one = found; one; one = one->ai_next)
  {
    const int made = socket(one->ai_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
    if (made < 0)
      continue;
    if (packet_bytes)
      set(made, TCP_MAXSEG, segment_bytes(one->ai_family, packet_bytes));
    set(made, TCP_NOTSENT_LOWAT, UNSENT_BYTES);
    set(made, TCP_NODELAY, 1);
    if (!bounded_backoff(made, BACKOFF_MS, DEAD_MS))
      set(made, TCP_USER_TIMEOUT, SOONER_DEAD_MS);
    pollfd watched = {made, POLLOUT, 0};
    socklen_t size = sizeof error;
    error = connect(made, one->ai_addr, one->ai_addrlen) ? errno : 0;
    if (error == EINPROGRESS && (error = ETIMEDOUT, poll(&watched, 1, one->ai_next ? NEXT_ADDRESS_MS : CONNECT_MS) > 0))
      getsockopt(made, SOL_SOCKET, SO_ERROR, &error, &size);
    if (!error)
      return made;
    ::close(made);
  }
  throw Fault(to.host + ":" + std::to_string(to.port) + ": " + std::strerror(error));
}

// Ask the system. The places are those of linux/tcp.h, of which the C library has a part.
Heard heard(int socket)
{
  char told[128];
  socklen_t size = sizeof told;
  Heard now;
  if (getsockopt(socket, IPPROTO_TCP, TCP_INFO, told, &size) || size < sizeof told)
    return now;
  uint32_t mss, in_flight, data_ms, ack_ms;
  uint64_t acked_bytes;
  std::memcpy(&mss, told + 16, sizeof mss);
  std::memcpy(&in_flight, told + 24, sizeof in_flight);
  std::memcpy(&data_ms, told + 52, sizeof data_ms);
  std::memcpy(&ack_ms, told + 56, sizeof ack_ms);
  std::memcpy(&acked_bytes, told + 120, sizeof acked_bytes);
  int waiting = 0;
  now.known = !ioctl(socket, SIOCOUTQ, &waiting);
  now.silent_us = INT64_C(1000) * std::min(data_ms, ack_ms);
  now.waiting_bytes = waiting;
  now.in_flight = in_flight > 0;
  now.full = acked_bytes > mss;
  return now;
}

int family_of(int socket)
{
  int family = AF_INET;
  socklen_t size = sizeof family;
  getsockopt(socket, SOL_SOCKET, SO_DOMAIN, &family, &size);
  return family;
}
}

Path::~Path()
{
  give_up_second();
  if (winner_ >= 0)
    ::close(winner_);
}

int Path::connected(const Address &to)
{
  int made = winner_;
  winner_ = -1;
  if (to.host != to_.host || to.port != to_.port)
  {
    give_up_second();
    if (made >= 0)
      ::close(made);
    made = -1;
    to_ = to;
  }
  if (made < 0)  // a second one may be under way still, and the first have ended
    made = second_.valid() ? second_.get() : connected_to(to, packet_bytes_);
  asked_us_ = now_us();
  silence_.clear();
  return made;
}

void Path::give_up_second()
{
  if (second_.valid())
    try
    {
      ::close(second_.get());
    }
    catch (const Fault &)
    {
    }
}

bool Path::wants_ping() const { return heard_.known && !heard_.waiting_bytes && heard_.silent_us >= PING_US; }

std::string Path::look(int socket)
{
  heard_ = heard(socket);
  const int64_t us = now_us();
  if (!heard_.in_flight)
    asked_us_ = us;
  const int64_t silent_us = std::min(us - asked_us_, heard_.silent_us);
  const bool ready = second_.valid() && second_.wait_for(std::chrono::seconds(0)) == std::future_status::ready;
  if (silent_us < SILENT_US)
  {
    if (ready)  // too late
      give_up_second();
    silence_.clear();
    return silence_;
  }
  if (silence_.empty())
  {
    char text[80];
    std::snprintf(text, sizeof text, "no answer for %.1f s: connecting anew beside it", double(silent_us) / 1e6);
    silence_ = text;
    std::fprintf(stderr, "bufgym: %s:%d: %s\n", to_.host.c_str(), to_.port, text);
    again_us_ = us;
  }
  if (!second_.valid() && us >= again_us_)
  {
    const auto smaller = std::find_if(std::begin(SMALLER_BYTES), std::end(SMALLER_BYTES) - 1, [this](int size) {
      return !packet_bytes_ || size < packet_bytes_;
    });
    const bool blocked = !heard_.full && heard_.waiting_bytes > *smaller - MOST_HEADER_BYTES;
    second_packet_bytes_ = blocked ? *smaller : packet_bytes_;
    second_ = std::async(std::launch::async, connected_to, to_, second_packet_bytes_);
  }
  if (!ready)
    return silence_;
  try
  {
    winner_ = second_.get();
  }
  catch (const Fault &)
  {
    again_us_ = us + AGAIN_US;
    return silence_;
  }
  const linger at_once = {1, 0};  // else the system repeats what was not acked until the connection is dead
  setsockopt(socket, SOL_SOCKET, SO_LINGER, &at_once, sizeof at_once);
  if (second_packet_bytes_ == packet_bytes_)
    throw Fault(silence_);
  packet_bytes_ = second_packet_bytes_;
  const std::string why = "the path takes handshakes but no full segments: smaller segments (MSS " +
                          std::to_string(segment_bytes(family_of(winner_), packet_bytes_)) + ")";
  std::fprintf(stderr, "bufgym: %s:%d: %s\n", to_.host.c_str(), to_.port, why.c_str());
  throw Fault(why);
}
}
