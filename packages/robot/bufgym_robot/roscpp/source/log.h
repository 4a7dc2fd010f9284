// A queue's log, a record a line, from which the simulator makes every decision again (bufgym live replay FILE).
#ifndef BUFGYM_ROSCPP_LOG_H
#define BUFGYM_ROSCPP_LOG_H
#include <cerrno>
#include <cinttypes>
#include <cstdio>
#include <string>

#include <unistd.h>

#include "policy.h"

namespace bufgym
{
class Log
{
public:
  Log() {}
  Log(const Log &) = delete;
  Log &operator=(const Log &) = delete;
  ~Log()
  {
    if (file_)
      std::fclose(file_);
  }

  // False where open would make no file; errno says why.
  static bool writable(const std::string &folder) { return access(folder.c_str(), W_OK | X_OK) == 0; }

  void open(const std::string &folder, std::string topic, const Policy &policy, int capacity)
  {
    static int count = 0;
    for (char &c : topic)
      c = c == '/' ? '_' : c;
    std::string path;
    do  // logs of other nodes and of earlier runs stay
      path = folder + "/" + topic.substr(1) + "-" + std::to_string(count++) + ".jsonl";
    while (!(file_ = std::fopen(path.c_str(), "wxe")) && errno == EEXIST);
    if (!file_)
      return;
    const Point point;
    std::setvbuf(file_, nullptr, _IOLBF, 1 << 16);
    std::fprintf(file_,
                 "{\"event\": \"settings\", \"us\": 0, \"policy\": \"%s\", \"parameters\": %s, \"capacity\": %d, "
                 "\"v\": {\"name\": \"%s\", \"numbers\": [%d, %.17g]}, \"topics\": [], \"max_bytes\": null, "
                 "\"decide_at\": \"arrival\", \"window\": 1, \"ends_us\": null}\n",
                 policy.name, policy.parameters, capacity, v.name.c_str(), int(v.numbers[0]), v.numbers[1]);
  }

  void put(int64_t us, int64_t seq, int64_t size_bytes, double x, int64_t carried, double took_us)
  {
    if (!file_)
      return;
    const Point point;
    std::fprintf(file_,
                 "{\"event\": \"put\", \"us\": %" PRId64 ", \"seq\": %" PRId64 ", \"size_bytes\": %" PRId64
                 ", \"x\": %.17g, \"topic\": 0, \"uniform\": 0.0, \"carried\": %" PRId64 ", \"took_us\": %.3f}\n",
                 us, seq, size_bytes, x, carried, took_us);
  }

  void event(const char *name, int64_t us, int64_t seq)
  {
    if (file_)
      std::fprintf(file_, "{\"event\": \"%s\", \"us\": %" PRId64 ", \"seq\": %" PRId64 "}\n", name, us, seq);
  }

  void gone(int64_t us, int64_t seq, int64_t carried)
  {
    if (file_)
      std::fprintf(file_,
                   "{\"event\": \"gone\", \"us\": %" PRId64 ", \"seq\": %" PRId64 ", \"carried\": %" PRId64 "}\n", us,
                   seq, carried);
  }

private:
  std::FILE *file_ = nullptr;
};
}
#endif
