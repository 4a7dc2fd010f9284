// The queue of one topic under a policy, and the thread that sends it to `bufgym ros2 receive` over TCP. No ROS here.
#ifndef BUFGYM_SENDER_SENDER_H
#define BUFGYM_SENDER_SENDER_H
#include <condition_variable>
#include <deque>
#include <memory>
#include <mutex>
#include <string>
#include <thread>

#include "frames.h"
#include "latched.h"
#include "log.h"
#include "path.h"
#include "policy.h"

namespace bufgym
{
// What /diagnostics tells of a topic. Rates are over the time since the last call of numbers().
struct Numbers
{
  int64_t arrived, left, dropped, queued, faults;
  double arrived_hz, left_hz, left_mbps;
  double oldest_s;  // age of the oldest queued message, 0 if there is none
  double qoi;       // information of what has left
  bool connected;
  std::string fault;  // why the last connection ended
};

class Sender
{
public:
  // log: a folder, or empty. Throws std::invalid_argument for a capacity that is none.
  Sender(const Address &to, const Published &topic, const Policy &policy, int capacity, const std::string &log = "");
  ~Sender() { close(0); }
  Sender(const Sender &) = delete;
  Sender &operator=(const Sender &) = delete;

  // Put a serialized message; the policy decides at once, and nothing blocks. x must not fall; without x it counts.
  void put(const void *data, size_t bytes);
  void put(const void *data, size_t bytes, double x);
  // Put the last message of this publisher, which no policy drops.
  void latch(uint64_t source, const void *data, size_t bytes, int64_t at_us);
  // Forget latched messages of publishers that are gone.
  void keep(const std::set<uint64_t> &living);
  // Send to another receiver from now on.
  void move(const Address &to);
  Numbers numbers();
  // Tell the thread to end, and do not wait for it.
  void stop();
  // Stop and wait; queued messages still go for so long at most.
  void close(double drain_s);

private:
  struct Message
  {
    std::shared_ptr<const std::string> body;
    int64_t number, seq, at_us;
    double x;
  };

  void put_at(const void *data, size_t bytes, const double *x);
  void run();
  void converse();
  void greet();
  void write(const std::string &data, int64_t number);
  std::shared_ptr<const std::string> body(const void *data, size_t bytes);
  void send_states();
  void send(const Message &message);
  void leave(const Message &message);
  void take_acks();
  void ready(short events);
  void look(bool idle);
  void next_in_socket(int64_t at_us);
  int64_t carried();
  int64_t stamp();
  void disconnect();

  std::mutex mutex_;  // guards what stands below it; a policy decides under it
  std::condition_variable changed_;
  Address to_;
  std::unique_ptr<Queue> queue_;
  Log log_;
  Latched latched_;
  std::deque<Message> held_;
  std::unique_ptr<Message> outgoing_;  // dequeued by the socket, and not yet left
  bool taken_ = false;                 // the thread has taken it
  bool closing_ = false, stopped_ = false, moved_ = false, connected_ = false;
  int64_t first_us_, last_us_ = 0, arrived_ = 0, left_ = 0, dropped_ = 0, faults_ = 0, dequeued_bytes_ = 0;
  int64_t dequeued_ = 0, carried_ = 0, left_bytes_ = 0, unwritten_ = 0;
  int64_t told_us_ = 0, told_arrived_ = 0, told_left_ = 0, told_bytes_ = 0;
  double qoi_ = 0, left_x_ = 0, latest_x_ = 0;
  std::string fault_;

  // Of the thread alone; socket_ is closed and opened under the mutex.
  int socket_ = -1, wake_ = -1;
  Path path_;
  int64_t looked_us_ = 0;
  std::string stream_, came_;
  std::deque<Message> unacked_;
  uint64_t most_bytes_ = 0;
  int64_t receiver_ = 0;        // its run
  int64_t last_state_ = -1;     // number of the latched message that this connection had last
  const std::string head_;
  std::thread thread_;
};
}
#endif
