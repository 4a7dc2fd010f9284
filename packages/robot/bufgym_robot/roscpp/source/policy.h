// A queue under a policy of bufgym, whichever policy it is, and V of this process.
#ifndef BUFGYM_ROSCPP_POLICY_H
#define BUFGYM_ROSCPP_POLICY_H
#include <cstdint>
#include <memory>
#include <string>

#include <locale.h>

namespace bufgym
{
const int MOST = 64;  // a larger queue_size stays roscpp's own queue

int64_t now_us();  // by the monotonic clock

// Times are in us of one clock, and must not fall.
struct Queue
{
  virtual ~Queue() {}
  // Decide on a message that arrives while so many bytes of the one before it are still to be sent, and carry it out.
  // Returns the slot that was evicted for it (0 = oldest), REJECT or ACCEPT.
  virtual int arrival(int64_t at_us, int64_t size_bytes, double x, int64_t left_bytes) = 0;
  // Which message was evicted or rejected last, by the number of those that came before it.
  virtual int64_t dropped() const = 0;
  // The socket takes the oldest message; its number.
  virtual int64_t dequeue(int64_t at_us) = 0;
  // The message in the socket has left it.
  virtual void sent(int64_t at_us, int64_t size_bytes) = 0;
};
enum Decision { REJECT = -1, ACCEPT = -2 };

struct Policy
{
  const char *name;
  const char *parameters;  // as JSON
  std::unique_ptr<Queue> (*make)(int64_t now_us, int capacity);
};
extern const Policy policies[];                // in policies.cpp, the last one without a name
const Policy *find(const std::string &name);  // null if there is none
std::string known();                          // all names, in one line

// While it lives a half is "0.5" in this thread, whatever locale the node has set.
class Point
{
public:
  Point();
  ~Point() { uselocale(before_); }
  Point(const Point &) = delete;
  Point &operator=(const Point &) = delete;

private:
  const locale_t before_;
};

// V: what a message adds at distance d from the one before it. One for all queues of the process, set before the first.
struct Value
{
  std::string name = "exponential:0.618";
  double numbers[2] = {0.0, -0.48126682151547946};  // 0 and ln b, or 1 and D
};
extern Value v;
bool set_value(const std::string &text);  // exponential:BASE or saturating:DISTANCE; false if it is neither
double value(double d);
double uniform();  // in [0, 1), for policies that draw lots
}

// A class over the C header of one policy, whose names begin with P (bufgym export --to c --prefix P).
#define BUFGYM_QUEUE(P)                                                                              \
  struct P##_class : bufgym::Queue                                                                   \
  {                                                                                                  \
    P##_queue q;                                                                                     \
    P##_class(int64_t now_us, int capacity)                                                          \
    {                                                                                                \
      P##_init(&q, now_us);                                                                          \
      q.capacity = capacity;                                                                         \
    }                                                                                                \
    int arrival(int64_t at_us, int64_t size_bytes, double x, int64_t left_bytes) override            \
    {                                                                                                \
      const P##_message message = {at_us, size_bytes, x, 0.0, 0, nullptr, bufgym::uniform(), 0};     \
      return P##_arrival(&q, message, left_bytes);                                                   \
    }                                                                                                \
    int64_t dropped() const override { return q.dropped.seq; }                                       \
    int64_t dequeue(int64_t at_us) override                                                          \
    {                                                                                                \
      P##_message head = {};                                                                         \
      P##_dequeue(&q, at_us, &head);                                                                 \
      return head.seq;                                                                               \
    }                                                                                                \
    void sent(int64_t at_us, int64_t size_bytes) override { P##_sent(&q, at_us, size_bytes); }       \
    static std::unique_ptr<bufgym::Queue> make(int64_t now_us, int capacity)                         \
    {                                                                                                \
      return std::unique_ptr<bufgym::Queue>(new P##_class(now_us, capacity));                        \
    }                                                                                                \
  };
#endif
