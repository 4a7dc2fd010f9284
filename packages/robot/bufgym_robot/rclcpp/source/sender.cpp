// The queue of a sender: puts, decisions and numbers.
#include "sender.h"

#include <algorithm>
#include <chrono>
#include <random>
#include <stdexcept>

#include <linux/sockios.h>
#include <sys/eventfd.h>
#include <sys/ioctl.h>
#include <unistd.h>

namespace bufgym
{
const int64_t MOST_BODY_BYTES = INT64_C(1) << 26;  // a receiver takes no more

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

// The head and the message; nothing once the queue is closed, or if a receiver would not take it.
std::shared_ptr<const std::string> Sender::body(const void *data, size_t bytes)
{
  const int64_t size = int64_t(head_.size() + bytes);
  if (closing_ || size > MOST_BODY_BYTES)
  {
    dropped_ += !closing_;
    if (!closing_)
      fault_ = "a message of " + std::to_string(size) + " bytes: must be at most " + std::to_string(MOST_BODY_BYTES);
    return nullptr;
  }
  auto made = std::make_shared<std::string>(head_);
  made->append(static_cast<const char *>(data), bytes);
  return made;
}

void Sender::latch(uint64_t source, const void *data, size_t bytes, int64_t at_us)
{
  std::lock_guard<std::mutex> lock(mutex_);
  if (const auto made = body(data, bytes))
    latched_.put(source, made, at_us);
  eventfd_write(wake_, 1);
}

void Sender::keep(const std::set<uint64_t> &living)
{
  std::lock_guard<std::mutex> lock(mutex_);
  latched_.keep(living);
  eventfd_write(wake_, 1);
}

void Sender::put_at(const void *data, size_t bytes, const double *known)
{
  std::lock_guard<std::mutex> lock(mutex_);
  const auto body = this->body(data, bytes);
  if (!body)
    return;
  const int64_t size = int64_t(body->size());
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

void Sender::stop()
{
  std::lock_guard<std::mutex> lock(mutex_);
  closing_ = stopped_ = true;
  eventfd_write(wake_, 1);
  changed_.notify_all();
}

void Sender::close(double drain_s)
{
  std::unique_lock<std::mutex> lock(mutex_);
  closing_ = true;
  eventfd_write(wake_, 1);
  changed_.notify_all();
  changed_.wait_for(lock, std::chrono::duration<double>(drain_s), [this] { return stopped_; });
  lock.unlock();
  stop();
  if (thread_.joinable())
    thread_.join();
  if (wake_ >= 0)
    ::close(wake_);
  wake_ = -1;
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
