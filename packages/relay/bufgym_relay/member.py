"""What a relay's hub knows of a connection, and of the other relays."""

from collections.abc import Sequence
from typing import Any, Protocol

from bufgym_relay.config import Rule
from bufgym_relay.outgoing import Outgoing
from bufgym_relay.rules import Permissions
from bufgym_relay.stored import StoredSession
from bufgym_relay.subscriber import Subscription
from bufgym_robot.wire import messages as wire


class Member(Protocol):
    """A connection that has said hello."""

    session: StoredSession
    permissions: Permissions
    subscriptions: dict[str, Subscription]
    sent: int  # number of messages sent to it
    acks: bool  # whether its client acks no_drop messages; otherwise it gets them like all others

    def offer(self, subscription: Subscription, outgoing: Outgoing) -> None:
        """Offer a message to its queues."""

    def reruled(self, rules: Sequence[Rule]) -> None:
        """Take new rules; end the connection if none is for it."""

    def wake(self) -> None:
        """Say that the store has something for it."""

    def tell(self, op: str, **fields: Any) -> None:
        """Tell its client this before any message."""

    def end(self, why: str) -> None:
        """Close it."""


class OtherRelays(Protocol):
    """The relays that share topics with this one."""

    state: str  # ``CONNECTED``, or why there is no connection

    async def hold(self, sender: StoredSession, message: wire.Message) -> bool | None:
        """Give them a no_drop message; return whether they may have it, None if that is not known."""

    def awaits(self, sender: StoredSession, message: wire.Message) -> None:
        """Note that their answer to a command is awaited, because its robot is not here."""

    def tick(self) -> None:
        """Give up the answers that do not come."""

    async def close(self) -> None:
        """Leave them."""
