"""What both ends decide, without sockets: when to try again, and what a frame leads to."""

import random

import relay_cases  # noqa: F401  (skips where the extra is missing)

from bufgym.relay import backoff
from bufgym.relay.backoff import Backoff


def test_tries_spread_out_and_begin_anew_after_a_connection_that_held() -> None:
    """At most 0.25 s, twice as long each time, at most 8 s; two clients of one fleet never agree."""
    now_s, drawn = 0.0, random.Random(3)
    one, other = (Backoff(random.Random(seed), lambda: now_s) for seed in (3, 4))
    for most_s in (0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 8.0):
        assert one.delay_s() == drawn.uniform(0.0, most_s) != other.delay_s()
    for held_s, most_s in ((backoff.HELD_S - 0.1, 8.0), (backoff.HELD_S, 0.25), (0.0, 0.5)):
        one.connected()
        now_s += held_s
        assert one.delay_s() == drawn.uniform(0.0, most_s)
    now_s += 100.0  # no connection held, however long the tries took
    assert one.delay_s() == drawn.uniform(0.0, 1.0)
