"""A policy as one C99 header, for programs that have no room for Python: ``bufgym export AGENT --to c --out policy.h``.

``parts/`` holds the queue, V, the features and the scorer in C, ``rules/`` a file for each rule that can be exported;
``header`` puts them together with the policy's numbers. ``calls`` records what an episode calls and what Python
decides: some of that goes into the header (``bufgym_parity``), and the tests compare millions of decisions.
"""

from bufgym.c.calls import CALL, random_episode, recorded
from bufgym.c.header import SUPPORTED, header, write

__all__ = ["CALL", "SUPPORTED", "header", "random_episode", "recorded", "write"]
