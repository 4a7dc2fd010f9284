// Latched state: the last message of each publisher of a topic, owed to the receiver until it has acked it. No ROS here.
#ifndef BUFGYM_SENDER_LATCHED_H
#define BUFGYM_SENDER_LATCHED_H
#include <cstdint>
#include <map>
#include <memory>
#include <set>
#include <string>

namespace bufgym
{
struct State
{
  uint64_t source;  // its publisher
  std::shared_ptr<const std::string> body;
  int64_t at_us;  // time of its publication
  bool acked;
};

class Latched
{
public:
  // A publisher's new state takes the place of its last one; the same publication once more changes nothing.
  void put(uint64_t source, std::shared_ptr<const std::string> body, int64_t at_us)
  {
    for (auto one = states_.begin(); one != states_.end(); ++one)
      if (one->second.source == source)
      {
        if (one->second.at_us == at_us && *one->second.body == *body)
          return;
        states_.erase(one);
        break;
      }
    states_[number_++] = {source, std::move(body), at_us, false};
  }

  // Where there are more states than living publishers, forget those of the others. What stays is owed again, because a
  // receiver keeps the latest.
  void keep(const std::set<uint64_t> &living)
  {
    if (states_.size() <= living.size())
      return;
    std::map<int64_t, State> kept;
    for (auto &[number, state] : states_)
      if (living.count(state.source))
        kept[number_++] = {state.source, std::move(state.body), state.at_us, false};
    states_ = std::move(kept);
  }

  // The receiver is another one.
  void owe_all()
  {
    for (auto &[number, state] : states_)
      state.acked = false;
  }

  void ack(int64_t number)
  {
    const auto found = states_.find(number);
    if (found != states_.end())
      found->second.acked = true;
  }

  // The oldest state owed whose number is greater; false if there is none.
  bool owed(int64_t after, int64_t &number, State &state) const
  {
    for (auto one = states_.upper_bound(after); one != states_.end(); ++one)
      if (!one->second.acked)
      {
        number = one->first;
        state = one->second;
        return true;
      }
    return false;
  }

  bool owes() const
  {
    int64_t number;
    State state;
    return owed(-1, number, state);
  }

private:
  std::map<int64_t, State> states_;  // by number, in which acks come
  int64_t number_ = 0;
};
}
#endif
