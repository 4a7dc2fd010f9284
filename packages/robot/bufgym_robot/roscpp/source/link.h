// A TCP connection over a link that dies and comes back, and under a robot whose address changes (wire/sockets.py).
#ifndef BUFGYM_ROSCPP_LINK_H
#define BUFGYM_ROSCPP_LINK_H
#include <cerrno>
#include <cstdlib>
#include <cstring>
#include <string>

#include <arpa/inet.h>
#include <dirent.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/socket.h>
#include <unistd.h>

#ifndef TCP_USER_TIMEOUT  // Linux has it since 2.6.37
#define TCP_USER_TIMEOUT 18
#endif

namespace bufgym
{
const int RTO_MAX_MS = 44;  // TCP_RTO_MAX_MS of linux/tcp.h since 6.15

// Let TCP try a dead link again after so long at the latest, and give the connection up after dead_ms without acks.
// False where the kernel cannot bound its backoff, which then grows to 120 s. The second limit stands beside the first:
// tcp_retries2 counts tries, and would give up after 15 short ones.
inline bool bounded_backoff(int socket, int most_ms, int dead_ms)
{
  const bool bounded = !setsockopt(socket, IPPROTO_TCP, RTO_MAX_MS, &most_ms, sizeof most_ms);
  if (bounded)
    setsockopt(socket, IPPROTO_TCP, TCP_USER_TIMEOUT, &dead_ms, sizeof dead_ms);
  return bounded;
}

inline std::string host_of(const sockaddr_storage &address)
{
  char text[INET6_ADDRSTRLEN] = "";
  if (address.ss_family == AF_INET)
    inet_ntop(AF_INET, &reinterpret_cast<const sockaddr_in &>(address).sin_addr, text, sizeof text);
  else if (address.ss_family == AF_INET6)
    inet_ntop(AF_INET6, &reinterpret_cast<const sockaddr_in6 &>(address).sin6_addr, text, sizeof text);
  return text;
}

// This machine's address from which a connection to the peer would leave; empty if no way leads there.
inline std::string address_to(const sockaddr *peer, socklen_t peer_size)
{
  sockaddr_storage now = {};
  socklen_t size = sizeof now;
  const int probe = socket(peer->sa_family, SOCK_DGRAM | SOCK_CLOEXEC, 0);
  const bool known = probe >= 0 && !connect(probe, peer, peer_size) &&
                     !getsockname(probe, reinterpret_cast<sockaddr *>(&now), &size);  // which sends nothing
  if (probe >= 0)
    close(probe);
  return known ? host_of(now) : "";
}

// The same for a host's name or address.
inline std::string address_to(const std::string &host)
{
  addrinfo *found = nullptr, hints = {};
  hints.ai_socktype = SOCK_DGRAM;
  if (getaddrinfo(host.c_str(), "11311", &hints, &found))
    return "";
  const std::string from = address_to(found->ai_addr, found->ai_addrlen);
  freeaddrinfo(found);
  return from;
}

// This machine's new address, if a connection that it made to the peer would now leave from another one; else empty.
inline std::string moved_to(int connection)
{
  sockaddr_storage own = {}, peer = {};
  socklen_t size = sizeof own, peer_size = sizeof peer;
  if (getsockname(connection, reinterpret_cast<sockaddr *>(&own), &size) ||
      getpeername(connection, reinterpret_cast<sockaddr *>(&peer), &peer_size))
    return "";
  const std::string now = address_to(reinterpret_cast<const sockaddr *>(&peer), peer_size);
  return now != host_of(own) ? now : "";
}

// Whether no interface of this machine has this address; false for a name.
inline bool is_gone(const std::string &address)
{
  addrinfo *found = nullptr, hints = {};
  hints.ai_flags = AI_NUMERICHOST;
  hints.ai_socktype = SOCK_DGRAM;
  if (getaddrinfo(address.c_str(), nullptr, &hints, &found))
    return false;
  const int probe = socket(found->ai_family, SOCK_DGRAM | SOCK_CLOEXEC, 0);
  const bool gone = probe >= 0 && bind(probe, found->ai_addr, found->ai_addrlen) && errno == EADDRNOTAVAIL;
  if (probe >= 0)
    close(probe);
  freeaddrinfo(found);
  return gone;
}

// End this process's TCP connections from this address, which is gone: whoever waits for them learns of it.
inline void end_connections_from(const std::string &address)
{
  DIR *all = opendir("/proc/self/fd");
  while (const dirent *one = all ? readdir(all) : nullptr)
  {
    const int socket = std::atoi(one->d_name);
    sockaddr_storage own = {}, peer = {};
    socklen_t size = sizeof own, peer_size = sizeof peer;
    if (!getpeername(socket, reinterpret_cast<sockaddr *>(&peer), &peer_size) &&
        !getsockname(socket, reinterpret_cast<sockaddr *>(&own), &size) && host_of(own) == address)
      shutdown(socket, SHUT_RDWR);
  }
  if (all)
    closedir(all);
}
}
#endif
