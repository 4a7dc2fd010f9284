"""The last messages of latched topics, which later subscribers get; each identity has its share of the room."""

from collections import Counter
from collections.abc import ItemsView
from typing import Final

from bufgym_relay.audit import Audit
from bufgym_relay.outgoing import Outgoing

MAX_BYTES: Final = 2**26
"""Limit on all of them; beyond, the identity with the most loses its largest."""


class Last:
    """Topic -> its last message."""

    def __init__(self, audit: Audit) -> None:
        self._audit = audit
        self._messages: dict[str, Outgoing] = {}
        self._owners: dict[str, str] = {}  # topic -> owner
        self._bytes: Counter[str] = Counter()  # owner -> bytes of all its last messages

    def items(self) -> ItemsView[str, Outgoing]:
        return self._messages.items()

    def get(self, topic: str) -> Outgoing | None:
        return self._messages.get(topic)

    def keep(self, outgoing: Outgoing, owner: str) -> None:
        """Keep a message in place of its topic's last one; ``owner`` is the key of the identity that said it."""
        topic = outgoing.message.topic
        self.forget(topic)
        self._messages[topic], self._owners[topic] = outgoing, owner
        self._bytes[owner] += outgoing.size_bytes
        while self._bytes.total() > MAX_BYTES:
            largest = max(self._bytes, key=self._bytes.__getitem__)
            sizes = {one: self._messages[one].size_bytes for one, who in self._owners.items() if who == largest}
            gone = max(sizes, key=sizes.__getitem__)  # a map before the transforms, which are small
            self._audit.repeated(what="latched", code="store_full", why=f"topic {gone}: its last message is forgotten")
            self.forget(gone)

    def forget(self, topic: str) -> None:
        """Keep nothing of a topic."""
        if (before := self._messages.pop(topic, None)) is not None:
            owner = self._owners.pop(topic)
            self._bytes[owner] -= before.size_bytes
            if not self._bytes[owner]:
                del self._bytes[owner]
