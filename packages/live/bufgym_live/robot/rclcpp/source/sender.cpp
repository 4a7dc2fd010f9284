#include "sender.h"

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <ctime>
#include <random>
#include <stdexcept>

#include <fcntl.h>
#include <linux/sockios.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/eventfd.h>
#include <sys/ioctl.h>
#include <sys/socket.h>
#include <unistd.h>

namespace bufgym
{
namespace
{
const int UNSENT_BYTES = 16384;   // the system wants more when less than this is unsent, whatever is in flight
const size_t PIECE_BYTES = 16384; // written at a time
const int DEAD_MS = 20000;        // a connection without acks for so long is given up
const int RETRY_MS = 500;
const int CONNECT_MS = 1000;
const size_t MOST_UNACKED = 256;
const int64_t MOST_BODY_BYTES = INT64_C(1) << 26;  // a receiver takes no more

// Why a connection ended.
struct Fault : std::runtime_error
{
  using runtime_error::runtime_error;
};

int64_t now_us()
{
  timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec * INT64_C(1000000) + t.tv_nsec / 1000;
}

void set(int socket, int option, int number) { setsockopt(socket, IPPROTO_TCP, option, &number, sizeof number); }

// Connect to the first of the host's addresses that answers.
int connected(const Address &to)
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
    set(made, TCP_NOTSENT_LOWAT, UNSENT_BYTES);
    set(made, TCP_NODELAY, 1);
    set(made, TCP_USER_TIMEOUT, DEAD_MS);
    pollfd watched = {made, POLLOUT, 0};
    socklen_t size = sizeof error;
    error = connect(made, one->ai_addr, one->ai_addrlen) ? errno : 0;
    if (error == EINPROGRESS && (error = ETIMEDOUT, poll(&watched, 1, CONNECT_MS) > 0))
      getsockopt(made, SOL_SOCKET, SO_ERROR, &error, &size);
    if (!error)
      return made;
    ::close(made);
  }
  throw Fault(to.host + ":" + std::to_string(to.port) + ": " + std::strerror(error));
}
}

Sender::Sender(
    const Address &to, const Published &topic, const Policy &policy, int capacity, const std::string &log)
    : to_(to), first_us_(now_us()), head_(head(topic))
{
  if (capacity < 1 || capacity > MOST)
    throw std::invalid_argument("capacity must be 1 to " + std::to_string(MOST));
  if (topic.name.size() > 255 || topic.type.size() > 255)
    throw std::invalid_argument(topic.name + ": names of topics and types have 255 bytes at most");
  queue_ = policy.make(0, capacity);
  if (!log.empty())
    log_.open(log, topic.name, policy, capacity);
  std::random_device random;
  while (stream_.size() < STREAM_BYTES)
    stream_ += char(random());
  wake_ = eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC);
  thread_ = std::thread(&Sender::run, this);
}

void Sender::put(const void *data, size_t bytes) { put_at(data, bytes, nullptr); }
void Sender::put(const void *data, size_t bytes, double x) { put_at(data, bytes, &x); }

void Sender::put_at(const void *data, size_t bytes, const double *known)
{
  auto body = std::make_shared<std::string>(head_);
  body->append(static_cast<const char *>(data), bytes);
  const int64_t size = int64_t(body->size());
  std::lock_guard<std::mutex> lock(mutex_);
  if (closing_)
    return;
  if (size > MOST_BODY_BYTES)
  {
    dropped_++;
    fault_ = "a message of " + std::to_string(size) + " bytes: must be at most " + std::to_string(MOST_BODY_BYTES);
    return;
  }
  const int64_t us = stamp(), seq = arrived_++, position = carried();
  const double x = known ? std::max(*known, latest_x_) : double(seq);
  latest_x_ = x;
  const auto begun = std::chrono::steady_clock::now();
  const int decision = queue_->arrival(us, size, x, dequeued_bytes_ - position);
  const std::chrono::duration<double, std::micro> took = std::chrono::steady_clock::now() - begun;
  log_.put(us, seq, size, x, position, took.count());
  if (decision >= 0)
    held_.erase(held_.begin() + decision);
  if (decision != ACCEPT)
  {
    dropped_++;
    log_.event("dropped", us, queue_->dropped());
  }
  if (decision != REJECT)
    held_.push_back({body, 0, seq, us, x});
  next_in_socket(us);
}

// The free socket takes the oldest message.
void Sender::next_in_socket(int64_t at_us)
{
  if (outgoing_ || held_.empty())
    return;
  outgoing_.reset(new Message(held_.front()));
  held_.pop_front();
  taken_ = false;
  unwritten_ = int64_t(outgoing_->body->size());
  outgoing_->number = dequeued_++;
  queue_->dequeue(at_us);
  dequeued_bytes_ += int64_t(outgoing_->body->size());
  log_.event("dequeued", at_us, outgoing_->seq);
  changed_.notify_all();
  eventfd_write(wake_, 1);
}

// Bytes that the link has carried so far, by what the system says is unsent.
int64_t Sender::carried()
{
  int unsent = 0;
  if (!outgoing_ || !connected_ || ioctl(socket_, SIOCOUTQNSD, &unsent))
    return carried_;
  return carried_ = std::max(carried_, std::min(dequeued_bytes_ - 1, dequeued_bytes_ - unwritten_ - unsent));
}

int64_t Sender::stamp() { return last_us_ = std::max(last_us_ + 1, now_us() - first_us_); }

void Sender::move(const Address &to)
{
  std::lock_guard<std::mutex> lock(mutex_);
  to_ = to;
  moved_ = true;
  changed_.notify_all();
  eventfd_write(wake_, 1);
}

Numbers Sender::numbers()
{
  std::lock_guard<std::mutex> lock(mutex_);
  const int64_t us = std::max(last_us_, now_us() - first_us_);
  const double s = double(std::max<int64_t>(1, us - told_us_)) / 1e6;
  const int64_t arrived = arrived_ - told_arrived_, left = left_ - told_left_, bytes = left_bytes_ - told_bytes_;
  told_us_ = us;
  told_arrived_ = arrived_;
  told_left_ = left_;
  told_bytes_ = left_bytes_;
  const double oldest_s = held_.empty() ? 0.0 : double(us - held_.front().at_us) / 1e6;
  Numbers all;
  all.arrived = arrived_;
  all.left = left_;
  all.dropped = dropped_;
  all.queued = int64_t(held_.size());
  all.faults = faults_;
  all.arrived_hz = double(arrived) / s;
  all.left_hz = double(left) / s;
  all.left_mbps = double(bytes) * 8e-6 / s;
  all.oldest_s = oldest_s;
  all.qoi = qoi_;
  all.connected = connected_;
  all.fault = fault_;
  return all;
}

void Sender::close(double drain_s)
{
  std::unique_lock<std::mutex> lock(mutex_);
  closing_ = true;
  eventfd_write(wake_, 1);
  changed_.notify_all();
  changed_.wait_for(lock, std::chrono::duration<double>(drain_s), [this] { return stopped_; });
  stopped_ = true;
  eventfd_write(wake_, 1);
  changed_.notify_all();
  lock.unlock();
  if (thread_.joinable())
    thread_.join();
  if (wake_ >= 0)
    ::close(wake_);
  wake_ = -1;
}

void Sender::run()
{
  std::unique_lock<std::mutex> lock(mutex_);
  while (!stopped_)
  {
    const Address to = to_;
    moved_ = false;
    lock.unlock();
    std::string fault;
    try
    {
      const int made = connected(to);
      {
        std::lock_guard<std::mutex> open(mutex_);
        socket_ = made;
      }
      converse();
    }
    catch (const Fault &error)
    {
      fault = error.what();
    }
    lock.lock();
    disconnect();
    if (fault.empty())  // all is sent and acked
      stopped_ = true;
    else if (!stopped_ && !moved_)
    {
      faults_++;
      fault_ = fault;
      changed_.wait_for(lock, std::chrono::milliseconds(RETRY_MS), [this] { return stopped_ || moved_; });
    }
  }
  changed_.notify_all();
}

void Sender::disconnect()
{
  connected_ = false;
  unwritten_ = outgoing_ ? int64_t(outgoing_->body->size()) : 0;  // all of it goes again
  came_.clear();
  if (socket_ >= 0)
    ::close(socket_);
  socket_ = -1;
}

// Wait for these events of the socket, and take acks meanwhile.
void Sender::ready(short events)
{
  for (;;)
  {
    pollfd watched[] = {{socket_, short(events | POLLIN), 0}, {wake_, POLLIN, 0}};
    const int found = poll(watched, 2, DEAD_MS);
    if (found < 0 && errno != EINTR)
      throw Fault(std::strerror(errno));
    if (found <= 0 && !events)
      return;
    if (found <= 0)
      continue;
    if (watched[1].revents)
    {
      eventfd_t count;
      eventfd_read(wake_, &count);
      std::lock_guard<std::mutex> lock(mutex_);
      if (stopped_ || moved_)
        throw Fault("closed here");
      if (!events)
        return;
    }
    if (watched[0].revents & ~POLLOUT)
      take_acks();
    if ((watched[0].revents & events) || (!events && watched[0].revents))
      return;
  }
}

// Write it all; number is that of the message whose body it is, or -1.
void Sender::write(const std::string &data, int64_t number)
{
  for (size_t done = 0; done < data.size();)
  {
    ready(POLLOUT);
    const ssize_t n = ::send(socket_, data.data() + done, std::min(PIECE_BYTES, data.size() - done), MSG_NOSIGNAL);
    if (n < 0 && errno != EAGAIN && errno != EINTR)
      throw Fault(std::strerror(errno));
    done += n > 0 ? size_t(n) : 0;
    std::lock_guard<std::mutex> lock(mutex_);
    if (outgoing_ && outgoing_->number == number)
      unwritten_ = int64_t(data.size() - done);
  }
}

// Name the stream; skip the messages that the receiver already has.
void Sender::greet()
{
  uint64_t first;
  {
    std::lock_guard<std::mutex> lock(mutex_);
    first = uint64_t(unacked_.empty() ? dequeued_ - (outgoing_ ? 1 : 0) : unacked_.front().number);
  }
  most_bytes_ = 0;
  write(header({GREETING, uint32_t(stream_.size()), first, 0, 0, 0.0}) + stream_, -1);
  const int64_t until_us = now_us() + DEAD_MS * INT64_C(1000);
  while (most_bytes_ == 0)
  {
    ready(0);
    if (now_us() > until_us)
      throw Fault("no answer to the greeting");
  }
  std::lock_guard<std::mutex> lock(mutex_);
  connected_ = true;
  fault_.clear();
}

void Sender::take_acks()
{
  char data[4096];
  const ssize_t n = recv(socket_, data, sizeof data, 0);
  if (n == 0)
    throw Fault("the receiver has closed the connection");
  if (n < 0 && errno != EAGAIN && errno != EINTR)
    throw Fault(std::strerror(errno));
  came_.append(data, n > 0 ? size_t(n) : 0);
  for (Frame frame; came_.size() >= HEADER_BYTES; came_.erase(0, HEADER_BYTES))
  {
    if (!parse(came_.data(), frame))
      throw Fault("no frame of a receiver");
    if (frame.kind == GREETING)
    {
      most_bytes_ = frame.seq;
      while (!unacked_.empty() && unacked_.front().number < int64_t(frame.number))
      {
        leave(unacked_.front());
        unacked_.pop_front();
      }
    }
    else
    {
      if (unacked_.empty() || unacked_.front().number != int64_t(frame.number))
        throw Fault("not the next ack");
      leave(unacked_.front());
      unacked_.pop_front();
    }
  }
}

void Sender::converse()
{
  greet();
  for (const Message &message : std::deque<Message>(unacked_))
    if (!unacked_.empty() && message.number >= unacked_.front().number)
      send(message);
  for (;;)
  {
    std::unique_ptr<Message> message;
    bool done = false;
    {
      std::lock_guard<std::mutex> lock(mutex_);
      if (outgoing_ && !taken_ && unacked_.size() < MOST_UNACKED)
      {
        message.reset(new Message(*outgoing_));
        taken_ = true;
      }
      done = closing_ && !outgoing_ && held_.empty() && unacked_.empty();
    }
    if (message)
    {
      unacked_.push_back(*message);
      send(*message);
    }
    else if (done)
      return write(header({GOODBYE, 0, 0, 0, 0, 0.0}), -1);
    else
      ready(0);
  }
}

void Sender::send(const Message &message)
{
  const size_t size = message.body->size();
  if (size > most_bytes_)
    throw Fault(
        "a message of " + std::to_string(size) + " bytes: the receiver takes at most " + std::to_string(most_bytes_));
  write(header({DATA, uint32_t(size), uint64_t(message.number), uint64_t(message.seq), message.at_us, message.x}), -1);
  write(*message.body, message.number);
  ready(POLLOUT);  // then little of it is unsent
  leave(message);
}

// The message has left the socket, which takes the next one.
void Sender::leave(const Message &message)
{
  std::lock_guard<std::mutex> lock(mutex_);
  if (!outgoing_ || outgoing_->number != message.number)
    return;  // it left on an earlier connection
  const int64_t us = stamp(), size = int64_t(message.body->size());
  queue_->sent(us, size);
  carried_ = dequeued_bytes_;
  log_.gone(us, message.seq, carried_);
  qoi_ += left_ ? value(message.x - left_x_) : 1.0;
  left_x_ = message.x;
  left_++;
  left_bytes_ += size;
  outgoing_.reset();
  next_in_socket(us);
}
}
