// Private members of roscpp's classes, for who needs them.
#ifndef BUFGYM_ROSCPP_NAMED_H
#define BUFGYM_ROSCPP_NAMED_H

namespace bufgym
{
// A private member of another class may be named in an explicit instantiation.
template <class Key, typename Key::type POINTER> struct Named { friend typename Key::type pointer(Key) { return POINTER; } };
#define NAMED(KEY, CLASS, TYPE, MEMBER)                                                  \
  struct KEY { typedef TYPE CLASS::*type; friend type pointer(KEY); };                   \
  template struct Named<KEY, &CLASS::MEMBER>;
}
#endif
