"""Limits of one identity over all its connections."""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from bufgym_relay.config import Limits
from bufgym_robot.wire.messages import RefusedError


class Bucket:
    """A token bucket that fills at ``rate`` a second and holds a second's worth."""

    def __init__(self, rate: float) -> None:
        self._rate = self._left = rate
        self._at_s: float | None = None

    def take(self, amount: float, now_s: float) -> bool:
        """Take ``amount`` and return True if enough was left; a full bucket allows any amount."""
        if self._at_s is not None:
            self._left = min(self._rate, self._left + max(0.0, now_s - self._at_s) * self._rate)
        self._at_s = now_s
        if self._left < min(amount, self._rate):
            return False
        self._left -= amount
        return True


class Quota:
    """Use that one identity has made of its limits; or that so many ``identities`` of an address have made."""

    def __init__(self, limits: Limits, idle_since_s: float, identities: int = 1) -> None:
        self.limits, self.idle_since_s = limits, idle_since_s
        self.messages, self.bytes = Bucket(limits.messages_per_s), Bucket(limits.bytes_per_s)
        self.frames = Bucket(limits.messages_per_s)  # that are no whole messages
        self.json = Bucket(limits.json_bytes_per_s * identities)
        self.topics: defaultdict[str, dict[str, None]] = defaultdict(dict)
        """Session -> the topics that it publishes on, the oldest first."""
        self.connections: list[Mapping[str, Any]] = []  # the subscriptions of each of its connections, by id

    def message(self, size_bytes: int, now_s: float) -> None:
        """Count a published message.

        Raises RefusedError: beyond a limit, as do all methods here.
        """
        if not (self.messages.take(1, now_s) and self.bytes.take(size_bytes, now_s)):
            most = f"{self.limits.messages_per_s} messages and {self.limits.bytes_per_s} bytes a second"
            raise RefusedError("too_fast", f"must be at most {most}")

    def topic(self, topic: str, session: str) -> None:
        """Count a topic that one of its sessions publishes on; if it has too many, the session with the most loses one.

        So a robot that renames its topics takes no places of its siblings.
        """
        if topic not in self.topics[session]:
            if sum(map(len, self.topics.values())) >= self.limits.topics:
                most = max(self.topics.values(), key=len)
                own = len(self.topics[session])
                for empty in [each for each, topics in self.topics.items() if not topics]:
                    del self.topics[empty]
                if own >= len(most):
                    raise RefusedError("too_many", f"topic {topic}: must be at most {self.limits.topics} topics")
                del most[next(iter(most))]
            self.topics[session][topic] = None

    def left(self, subscriptions: Mapping[str, Any]) -> None:
        """Count the connection with these subscriptions no more."""
        self.connections = [each for each in self.connections if each is not subscriptions]

    @property
    def queues(self) -> int:
        """Queues of its subscriptions, over all its connections."""
        return sum(one.queues for each in self.connections for one in each.values())

    def subscribe(self, id: str, before: Mapping[str, Any], cost: int) -> None:
        """Check that a connection with these subscriptions may have one of this id, which counts for ``cost``."""
        others = (one for each in self.connections for one in each.values() if one is not before.get(id))
        if sum(one.pattern.cost for one in others) + cost > self.limits.subscriptions:
            raise RefusedError("too_many", f"must be at most {self.limits.subscriptions} subscriptions")


KEPT_S = 60.0  # Time for which a quota outlives its last connection, so that reconnecting does not reset it
MAX_QUOTAS = 100_000


class Quotas:
    """Quotas of all identities, and of all addresses, whose keys begin with "@"."""

    def __init__(self, limits: Limits, clock: Callable[[], float]) -> None:
        self._limits, self._clock = limits, clock
        self._quotas: dict[str, Quota] = {}

    def of(self, key: str) -> Quota:
        """Find the quota of an identity."""
        if key not in self._quotas:
            if len(self._quotas) >= MAX_QUOTAS:
                self.tidy(kept_s=0.0)
            self._quotas[key] = Quota(self._limits, self._clock(), self._limits.identities if key[:1] == "@" else 1)
        return self._quotas[key]

    @contextmanager
    def connection(self, key: str, subscriptions: Mapping[str, Any], address: str = "") -> Iterator[Quota]:
        """Count a connection of an identity at an address, with whatever subscriptions it gets, until the block ends.

        Raises RefusedError: too many.
        """
        quota, neighbours = self.of(key), self.of(f"@{address}")
        if len(quota.connections) >= self._limits.connections:
            raise RefusedError("too_many", f"must be at most {self._limits.connections} connections")
        for each in (quota, neighbours):
            each.connections.append(subscriptions)
        try:
            yield quota
        finally:
            for each in (quota, neighbours):
                each.left(subscriptions)
                each.idle_since_s = self._clock()

    def may_have_queue(self, key: str, address: str) -> bool:
        """Whether the identity, and all at its address together, may have one more queue."""
        limits, neighbours = self._limits, self.of(f"@{address}")
        return self.of(key).queues < limits.queues and neighbours.queues < limits.queues * limits.identities

    def tidy(self, kept_s: float = KEPT_S) -> None:
        """Forget quotas that have not been used for ``kept_s``."""
        now_s = self._clock()
        for key, quota in list(self._quotas.items()):
            if not quota.connections and now_s - quota.idle_since_s >= kept_s:
                del self._quotas[key]
