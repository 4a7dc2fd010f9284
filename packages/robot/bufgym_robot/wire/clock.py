"""The relay's clock as its clients know it: it decides how old a message is, so no other clock has to be right.

The relay's clock counts us and never jumps while the relay runs. Each message says when the relay took it. So a client
knows a bound: the clock is at least that far. The answer to a question gives the other: it was no further than that
when the question went.
"""

import math
import time
from collections.abc import Callable
from typing import Final

ASK_S: Final = 2.0  # Time between two questions of a client
_MINUTE_S: Final = 60.0
_DRIFT: Final = 5e-4  # most that two clocks drift apart, s for each s


class ServerClock:
    """The relay's own clock: the time at its start, in us since 1970, and what has passed since."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._offset_s = time.time() - clock()

    def now_us(self) -> int:
        """Time now."""
        return round((self._clock() + self._offset_s) * 1e6)


class RelayClock:
    """Bounds of the relay's clock, at a client; a new connection begins anew."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.clock = clock
        self.begin()

    def begin(self) -> None:
        """Forget all: the next relay may have another clock."""
        self._low_s, self._high_s, self._set_s = -math.inf, math.inf, self.clock()

    @property
    def known(self) -> bool:
        """Whether the relay has said its time."""
        return self._low_s > -math.inf

    def heard(self, relay_us: int, asked_s: float | None = None) -> None:
        """Take note of the relay's time; of an answer, with the own time of its question."""
        now_s, relay_s = self.clock(), relay_us / 1e6
        apart_s, self._set_s = _DRIFT * (now_s - self._set_s), now_s
        self._low_s = max(self._low_s - apart_s, relay_s - now_s)
        self._high_s = max(self._low_s, self._high_s + apart_s)
        if asked_s is not None:
            self._high_s = max(self._low_s, min(self._high_s, relay_s - asked_s))

    def earliest_us(self, at_s: float) -> int:
        """Give the relay's time at this own time, or less."""
        return math.floor((at_s + self._low_s - _DRIFT * (self.clock() - self._set_s)) * 1e6)

    def is_past(self, relay_us: int) -> bool:
        """Whether this time of the relay's may be over."""
        now_s = self.clock()
        return now_s + self._high_s + _DRIFT * (now_s - self._set_s) > relay_us / 1e6


class Delays:
    """Delays of another relay's messages beyond the least of the last minutes. Two clocks never agree."""

    def __init__(self) -> None:
        self._since_s, self._before_s, self._least_s = -math.inf, math.inf, math.inf

    def extra_s(self, delay_s: float, now_s: float) -> float:
        """Take a message's delay by two clocks; give what exceeds the usual."""
        if now_s - self._since_s > _MINUTE_S:
            self._since_s, self._before_s, self._least_s = now_s, self._least_s, math.inf
        self._least_s = min(self._least_s, delay_s)
        return delay_s - min(self._before_s, self._least_s)
