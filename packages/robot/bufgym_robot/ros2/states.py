"""One latched topic at the receiving end: the last message of each publisher, in the history of one writer.

DDS gives a reader that comes late as many messages as the writer's history is deep. So the depth is the number of
publishers. A publisher's newer message would push another's only one out of the history, so that one is published
again before it.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import takewhile
from typing import Any, Final

from bufgym_robot.ros2.names import Published

MOST_STREAMS: Final = 16
"""Latest senders of a topic whose states are kept. A robot that starts again is another sender."""


class States:
    """Call ``take`` with each message; ``writer`` has the last of each publisher, the latest at the end."""

    def __init__(self, make: Callable[[Published], Any], destroy: Callable[[Any], None]) -> None:
        self._make, self._destroy = make, destroy
        self.writer: Any = None
        self._topic: Published | None = None
        self._last: dict[int, tuple[str, bytes]] = {}  # publisher -> its sender and message, in the order published

    def take(self, topic: Published, stream: str, source: int, message: bytes) -> None:
        """Publish the message of this publisher; ``topic.depth`` is the number of publishers that the sender sees."""
        older = list(takewhile(lambda one: one != source, self._last)) if source in self._last else []
        self._last[source] = stream, message
        again = [*older, source]
        for one in again:
            self._last[one] = self._last.pop(one)
        self._trim(stream, max(1, topic.depth))
        topic = replace(topic, depth=max(topic.depth, len(self._last)))
        if topic != self._topic:
            self._renew(topic)
            again = list(self._last)
        for one in again:
            if self.writer is not None and one in self._last:
                self.writer.publish(self._last[one][1])

    def _trim(self, stream: str, most: int) -> None:
        """Keep the latest ``most`` publishers of this sender, and the latest senders."""
        own = [one for one, (sender, _) in self._last.items() if sender == stream]
        senders = list(dict.fromkeys(sender for sender, _ in reversed(self._last.values())))
        gone = {*own[:-most], *(one for one, (sender, _) in self._last.items() if sender in senders[MOST_STREAMS:])}
        for one in gone:
            del self._last[one]

    def _renew(self, topic: Published) -> None:
        if self.writer is not None:
            self._destroy(self.writer)
        self._topic, self.writer = topic, self._make(topic)
