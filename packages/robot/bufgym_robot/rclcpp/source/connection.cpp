// The connection of a sender: its thread connects, writes messages and takes acks.
#include "link.h"
#include "sender.h"

#include <algorithm>
#include <cerrno>
#include <cstring>

#include <poll.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

namespace bufgym
{
namespace
{
const size_t PIECE_BYTES = 16384;  // written at a time
const int ANSWER_MS = 20000;       // for the answer to the greeting
const int RETRY_MS = 500;
const int LOOK_MS = 250;  // between two looks at the path
const size_t MOST_UNACKED = 256;
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
      const int made = path_.connected(to);
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
      if (!path_.won())
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
    const int found = poll(watched, 2, LOOK_MS);
    if (found < 0 && errno != EINTR)
      throw Fault(std::strerror(errno));
    look(!events);
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

// From time to time look at this machine's address and at the path; an idle one is asked for a sign of life.
void Sender::look(bool idle)
{
  if (now_us() - looked_us_ < LOOK_MS * INT64_C(1000))
    return;
  looked_us_ = now_us();
  const std::string address = moved_to(socket_);
  if (!address.empty())
  {
    path_.moved();
    throw Fault("this machine's address has become " + address);
  }
  const std::string silence = path_.look(socket_);
  if (idle && most_bytes_ && path_.wants_ping())
  {
    const std::string ping = header({PING, 0, 0, 0, 0, 0.0});
    if (::send(socket_, ping.data(), ping.size(), MSG_NOSIGNAL) != ssize_t(ping.size()))
      throw Fault(std::strerror(errno));
  }
  std::lock_guard<std::mutex> lock(mutex_);
  connected_ = most_bytes_ && silence.empty();
  fault_ = connected_ || !silence.empty() ? silence : fault_;
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
  const int64_t until_us = now_us() + ANSWER_MS * INT64_C(1000);
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
    if (frame.kind == LATCHED)
    {
      std::lock_guard<std::mutex> lock(mutex_);
      latched_.ack(int64_t(frame.number));
    }
    else if (frame.kind == GREETING)
    {
      most_bytes_ = frame.seq;
      if (receiver_ != frame.at_us)
      {
        std::lock_guard<std::mutex> lock(mutex_);
        latched_.owe_all();
      }
      receiver_ = frame.at_us;
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
  last_state_ = -1;
  send_states();
  for (const Message &message : std::deque<Message>(unacked_))
    if (!unacked_.empty() && message.number >= unacked_.front().number)
      send(message);
  for (;;)
  {
    send_states();
    std::unique_ptr<Message> message;
    bool done = false;
    {
      std::lock_guard<std::mutex> lock(mutex_);
      if (outgoing_ && !taken_ && unacked_.size() < MOST_UNACKED)
      {
        message.reset(new Message(*outgoing_));
        taken_ = true;
      }
      done = closing_ && !outgoing_ && held_.empty() && unacked_.empty() && !latched_.owes();
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

// Send the latched messages that are owed and were not yet sent on this connection.
void Sender::send_states()
{
  for (;;)
  {
    State state;
    {
      std::lock_guard<std::mutex> lock(mutex_);
      if (!latched_.owed(last_state_, last_state_, state))
        return;
    }
    const uint32_t size = uint32_t(state.body->size());
    write(header({LATCHED, size, uint64_t(last_state_), state.source, state.at_us, 0.0}) + *state.body, -1);
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
}
