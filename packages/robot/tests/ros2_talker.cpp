// Puts messages into a Sender of bufgym_sender at a rate, and prints its numbers as JSON; no ROS.
//   talker HOST PORT POLICY CAPACITY LOG COUNT BYTES HZ
// It then waits for a line on its input, where "move PORT" changes the receiver before COUNT more messages.
#include <chrono>
#include <iostream>
#include <thread>

#include "sender.h"

int main(int, char **words)
{
  bufgym::Published topic;
  topic.name = "/camera";
  topic.type = "sensor_msgs/msg/Image";
  topic.reliable = false;
  topic.manual = true;
  topic.depth = 300;
  topic.deadline_ns = 5000000000;
  topic.lifespan_ns = 1;
  topic.lease_ns = INT64_C(1) << 40;
  const bufgym::Policy *policy = bufgym::find(words[3]);
  bufgym::Sender sender({words[1], std::stoi(words[2])}, topic, *policy, std::stoi(words[4]), words[5]);
  const std::string body(std::stoul(words[7]), 'b');
  for (std::string command = "go"; command != "end"; std::cin >> command)
  {
    if (command == "move")
    {
      int port = 0;
      std::cin >> port;
      sender.move({words[1], port});
    }
    auto due = std::chrono::steady_clock::now();
    for (int k = 0; k < std::stoi(words[6]); k++)
    {
      sender.put(body.data(), body.size());
      std::this_thread::sleep_until(due += std::chrono::microseconds(int64_t(1e6 / std::stod(words[8]))));
    }
    std::cout << "put" << std::endl;
  }
  sender.close(20);
  const bufgym::Numbers all = sender.numbers();
  std::cout.precision(17);
  std::cout << "{\"arrived\": " << all.arrived << ", \"left\": " << all.left << ", \"dropped\": " << all.dropped
            << ", \"queued\": " << all.queued << ", \"faults\": " << all.faults << ", \"qoi\": " << all.qoi << "}" << std::endl;
}
