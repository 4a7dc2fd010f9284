// A sender's connections, and a watch over their path: a second one races one on which nothing is heard
// (bufgym_robot/path_watch.py). No ROS here.
#ifndef BUFGYM_SENDER_PATH_H
#define BUFGYM_SENDER_PATH_H
#include <cstdint>
#include <future>
#include <stdexcept>
#include <string>

namespace bufgym
{
// Why a connection ended.
struct Fault : std::runtime_error
{
  using runtime_error::runtime_error;
};

struct Address
{
  std::string host;
  int port = 7410;
};

// What the system has heard of a connection's other end.
struct Heard
{
  int64_t silent_us = 0;  // since an ack of TCP, or data
  int64_t waiting_bytes = 0;  // not acked, sent or not
  bool known = false, in_flight = false, full = true;  // full: as much as a full segment was acked
};

class Path
{
public:
  Path() = default;
  ~Path();
  Path(const Path &) = delete;
  Path &operator=(const Path &) = delete;

  // The connection that has won, or a new one. Throws a Fault.
  int connected(const Address &to);
  // Whether a second connection has won.
  bool won() const { return winner_ >= 0; }
  // Why a second connection is being tried, or empty. Throws a Fault once it has won.
  std::string look(int socket);
  // Whether the last look found nothing on its way, and nothing heard for 1 s.
  bool wants_ping() const;
  // This machine has a new address.
  void moved() { packet_bytes_ = 0; }

private:
  void give_up_second();

  Address to_;
  Heard heard_;
  int64_t asked_us_ = 0, again_us_ = 0;
  int packet_bytes_ = 0;  // largest packets, both ways; 0: as large as the interface takes
  int second_packet_bytes_ = 0, winner_ = -1;
  std::string silence_;
  std::future<int> second_;
};
}
#endif
