"""A policy as one C99 header for programs without Python, made by ``bufgym export AGENT --to c --out policy.h``.

``parts/`` holds the queue, V and what policies share in C, and ``rules/`` a file for each exportable rule.
``header`` puts them together with the policy's numbers. ``calls`` records an episode's calls and Python's decisions.
Some of them go into the header as ``bufgym_parity``, and the tests compare millions.
"""

from bufgym_live.robot.c.calls import CALL, random_episode, recorded
from bufgym_live.robot.c.header import SUPPORTED, header, write

__all__ = ["CALL", "SUPPORTED", "header", "random_episode", "recorded", "write"]
