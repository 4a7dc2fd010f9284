"""A policy as one C99 header for programs without Python, made by ``bufgym export AGENT --to c --out policy.h``.

``parts/`` holds the queue in C. ``header`` puts it together with the policy's functions, which ``bufgym.kernels``
translates, and its numbers. ``calls`` records an episode's calls and Python's decisions. Some of them go into the
header as ``bufgym_parity``, and the tests compare millions.
"""

from bufgym_robot.c.calls import CALL, random_episode, recorded
from bufgym_robot.c.header import header, supported, write

__all__ = ["CALL", "header", "random_episode", "recorded", "supported", "write"]
