"""How many messages fill a path, learned from its acks.

Where a library hides its socket, only the receiver's acks tell how far the link is. Waiting for each ack would leave
the link idle for a round trip a message. So as many messages are on their way as cover the round trip at the link's
rate, and the one that is being sent. It is the bandwidth-delay product in messages.
"""

import math
from collections import deque
from typing import Final

_ACKS: Final = 8  # latest acks over which rate and size are taken
_IDLE: Final = 0.03  # share of the time that the link may be idle before another message is sent ahead


class PathWindow:
    """Messages that may be on their way, for a path whose round trip is ``round_trip_s`` when nothing is."""

    def __init__(self, round_trip_s: float = 0.0) -> None:
        self._round_trip_s = round_trip_s
        self._sent_s: dict[int, float] = {}
        self._acks: deque[tuple[int, float]] = deque(maxlen=_ACKS)
        """Bytes of a message, and the time that the path took for it alone, s."""
        self._acked_s = -math.inf

    def sends(self, number: int, now_s: float) -> None:
        """Note that a message is handed to the library."""
        self._sent_s[number] = now_s

    def acked(self, number: int, size_bytes: int, now_s: float) -> None:
        """Note the ack of a message, which the path began to carry when it was sent, or at the ack before if later."""
        begun_s = max(self._acked_s, self._sent_s.pop(number, now_s))
        self._acks.append((size_bytes, now_s - begun_s))
        self._acked_s = now_s

    @property
    def messages(self) -> int:
        """Number of messages that fill the path, at least 1.

        With a window too small, acks come at the window's rate and not at the link's. The result is then larger than
        that window all the same, until the path is full.
        """
        taken_s = sum(taken_s for _, taken_s in self._acks)
        ahead = self._round_trip_s * len(self._acks) / taken_s if taken_s > 0 else 0.0
        return max(1, math.ceil((1 - _IDLE) * (1 + ahead)))
