#include "policy.h"

#include <cmath>
#include <random>
#include <cstdlib>
#include <ctime>

namespace bufgym
{
int64_t now_us()
{
  timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec * INT64_C(1000000) + t.tv_nsec / 1000;
}

const Policy *find(const std::string &name)
{
  for (const Policy *policy = policies; policy->name; policy++)
    if (name == policy->name)
      return policy;
  return nullptr;
}

std::string known()
{
  std::string names;
  for (const Policy *policy = policies; policy->name; policy++)
    names += (names.empty() ? "" : ", ") + std::string(policy->name);
  return names;
}

Point::Point() : before_(uselocale(nullptr))
{
  static const locale_t plain = newlocale(LC_NUMERIC_MASK, "C", nullptr);
  uselocale(plain);
}

Value v;

bool set_value(const std::string &text)
{
  const size_t colon = text.find(':');
  if (colon == std::string::npos)
    return false;
  const Point point;
  char *end = nullptr;
  const double number = std::strtod(text.c_str() + colon + 1, &end);
  const bool saturating = text.compare(0, colon, "saturating") == 0;
  if (*end || (saturating ? !(number > 0 && std::isfinite(number)) : text.compare(0, colon, "exponential") != 0 || !(number > 0 && number < 1)))
    return false;
  v.name = text;
  v.numbers[0] = saturating;
  v.numbers[1] = saturating ? number : std::log(number);
  return true;
}

double value(double d)
{
  if (v.numbers[0] == 0.0)
    return 1.0 - std::exp(d * v.numbers[1]);
  const double part = d / v.numbers[1];
  return part < 1.0 ? part : 1.0;
}

double uniform()
{
  static thread_local std::mt19937_64 source(std::random_device{}());
  return std::uniform_real_distribution<double>(0.0, 1.0)(source);
}
}
