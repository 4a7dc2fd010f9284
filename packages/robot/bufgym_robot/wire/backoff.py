"""Delays between a client's tries to connect: they grow and are drawn at random, so that a fleet spreads out."""

import random
import time
from collections.abc import Callable
from typing import Final

FIRST_S: Final = 0.2
MOST_S: Final = 8.0  # For a client that is refused, or whose connections do not hold
AWAY_S: Final = 1.0  # For a relay that cannot be reached, which costs it nothing: clients are back this soon
HELD_S: Final = 5.0  # Time after which a connection has held


class Backoff:
    """Exponential backoff with full jitter; ``page/relay.js`` does the same."""

    def __init__(self, uniform: random.Random | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self._uniform, self._clock = uniform or random.Random(), clock
        self._most_s = FIRST_S
        self._since_s: float | None = None

    def connected(self) -> None:
        """Note that the relay has let this client in."""
        self._since_s = self._clock()

    def delay_s(self, away: bool = False) -> float:
        """Draw the time until the next try, as the last one has ended; a connection that held begins anew.

        ``away`` says that nobody answered the last one.
        """
        if self._since_s is not None and self._clock() - self._since_s >= HELD_S:
            self._most_s = FIRST_S
        self._since_s = None
        delay_s = self._uniform.uniform(0.0, min(self._most_s, AWAY_S if away else MOST_S, MOST_S))
        self._most_s = min(2 * self._most_s, MOST_S)
        return delay_s
