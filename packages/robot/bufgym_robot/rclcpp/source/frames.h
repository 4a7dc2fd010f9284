// Frames of bufgym's TCP connection (bufgym_robot/frames.py), and the head of a message of ROS 2 (ros2/names.py).
// All numbers are big-endian.
#ifndef BUFGYM_SENDER_FRAMES_H
#define BUFGYM_SENDER_FRAMES_H
#include <cstdint>
#include <cstring>
#include <string>

namespace bufgym
{
enum Kind { GREETING = 1, DATA = 2, ACK = 3, GOODBYE = 4, LATCHED = 5, PING = 6 };
const size_t HEADER_BYTES = 44, STREAM_BYTES = 16;

struct Frame
{
  Kind kind;
  uint32_t body_bytes;
  uint64_t number, seq;
  int64_t at_us;
  double x;
};

// A topic with its publisher's quality of service.
struct Published
{
  std::string name, type;  // "/camera/image", "sensor_msgs/msg/Image"
  bool reliable = true, transient_local = false, manual = false;  // manual: liveliness by topic
  uint16_t depth = 10;  // of a latched topic the number of its publishers
  int64_t deadline_ns = 0, lifespan_ns = 0, lease_ns = 0;  // 0: none
};

// Whether the last message of each publisher is state, owed to every late reader; a log is none.
inline bool latched(const Published &topic) { return topic.transient_local && topic.name != "/rosout"; }

inline void put_number(std::string &out, uint64_t number, int bytes)
{
  for (int k = bytes - 1; k >= 0; k--)
    out += char(number >> 8 * k);
}

inline uint64_t number_at(const char *data, int bytes)
{
  uint64_t number = 0;
  for (int k = 0; k < bytes; k++)
    number = number << 8 | uint8_t(data[k]);
  return number;
}

inline std::string header(const Frame &frame)
{
  uint64_t x;
  std::memcpy(&x, &frame.x, sizeof x);
  std::string out = "bG";
  put_number(out, frame.kind, 1);
  put_number(out, 0, 1);
  put_number(out, frame.body_bytes, 4);
  put_number(out, frame.number, 8);
  put_number(out, frame.seq, 8);
  put_number(out, uint64_t(frame.at_us), 8);
  put_number(out, x, 8);
  put_number(out, 0, 4);  // the topic's number: each topic has a connection of its own
  return out;
}

// Read a receiver's frame, which has no body; false if it is none.
inline bool parse(const char *data, Frame &frame)
{
  const uint64_t kind = number_at(data + 2, 1);
  const bool known = kind == GREETING || kind == ACK || kind == LATCHED;
  if (data[0] != 'b' || data[1] != 'G' || !known || number_at(data + 4, 4))
    return false;
  frame = {Kind(kind), 0, number_at(data + 8, 8), number_at(data + 16, 8), int64_t(number_at(data + 24, 8)), 0.0};
  return true;
}

// What goes before each serialized message.
inline std::string head(const Published &topic)
{
  std::string out;
  put_number(out, topic.name.size(), 1);
  put_number(out, topic.type.size(), 1);
  put_number(out, topic.reliable | topic.transient_local << 1 | topic.manual << 2, 1);
  put_number(out, topic.depth, 2);
  for (int64_t ns : {topic.deadline_ns, topic.lifespan_ns, topic.lease_ns})
    put_number(out, uint64_t(ns), 8);
  return out + topic.name + topic.type;
}
}
#endif
