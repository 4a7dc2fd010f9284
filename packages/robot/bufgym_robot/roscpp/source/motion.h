// x: how far the scene has moved on, in fields of view, summed from a robot's odometry (bufgym_robot/wire/odometry.py).
#ifndef BUFGYM_ROSCPP_MOTION_H
#define BUFGYM_ROSCPP_MOTION_H
#include <algorithm>
#include <cmath>
#include <mutex>
#include <string>

namespace bufgym
{
class Motion
{
public:
  static constexpr double FIELD_OF_VIEW = 60.0 * M_PI / 180.0, SCENE_M = 2.0, RATE_HZ = 30.0;

  double x()
  {
    std::lock_guard<std::mutex> lock(mutex_);
    return x_;
  }

  // Take a pose: stamp, place, and turn as a quaternion x, y, z, w.
  void take(const std::string &frame, double time_s, const double (&place)[3], const double (&turned)[4])
  {
    double turn[4] = {turned[0], turned[1], turned[2], turned[3]};
    const double norm = std::sqrt(turn[0] * turn[0] + turn[1] * turn[1] + turn[2] * turn[2] + turn[3] * turn[3]);
    if (!(norm > 0.9 && norm < 1.1 && std::isfinite(place[0] + place[1] + place[2])))
      return;  // some drivers send zeros at first
    for (double &part : turn)
      part /= norm;
    std::lock_guard<std::mutex> lock(mutex_);
    if (frame != frame_ && known_)
      return;  // poses of one frame count, the first one's
    if (known_ && time_s >= time_s_)
    {
      if (time_s - time_s_ < 0.9 / RATE_HZ)  // odometry at this very rate jitters by some percent
        return;
      double apart = 0, along = 0, moved = 0, same = 0;
      for (int k = 0; k < 4; k++)
        same += turn[k] * turn_[k];
      const double sign = same < 0 ? -1 : 1;  // q and -q are one rotation
      for (int k = 0; k < 4; k++)
      {
        apart += std::pow(turn_[k] - sign * turn[k], 2);
        along += std::pow(turn_[k] + sign * turn[k], 2);
      }
      for (int k = 0; k < 3; k++)
        moved += std::pow(place[k] - place_[k], 2);
      // By the half-angle's tangent: an arc cosine would lose small angles.
      x_ += 4 * std::atan2(std::sqrt(apart), std::sqrt(along)) / FIELD_OF_VIEW + std::sqrt(moved) / SCENE_M;
    }
    frame_ = frame;
    time_s_ = time_s;
    std::copy(turn, turn + 4, turn_);
    std::copy(place, place + 3, place_);
    known_ = true;
  }

private:
  std::mutex mutex_;
  bool known_ = false;
  std::string frame_;
  double x_ = 0, time_s_ = 0, turn_[4], place_[3];
};
}
#endif
