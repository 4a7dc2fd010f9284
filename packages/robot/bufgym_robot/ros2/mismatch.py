"""What a reader asks for and a publisher does not give, said in words: DDS then delivers nothing.

A publisher may give more than its reader asks for, never less, so each policy has one such pair.
"""

from collections.abc import Callable
from typing import Any, Final

_PAIRS: Final = {
    "DURABILITY": ("transient local", "volatile"),
    "RELIABILITY": ("reliable", "best effort"),
    "DEADLINE": ("a shorter deadline", "slower"),
    "LIVELINESS": ("a stricter liveliness", "less lively"),
}
"""Policy -> what the reader asks for, what the publisher gives."""


def of_publisher(name: str, say: Callable[[str], None]) -> Any:
    """Make callbacks of a publisher that name the mismatch with a reader here."""
    from rclpy.event_handler import PublisherEventCallbacks

    return PublisherEventCallbacks(incompatible_qos=lambda event: say(_words(name, event, "a reader here", "of it")))


def of_subscription(name: str, say: Callable[[str], None]) -> Any:
    """Make callbacks of a subscription that name the mismatch with a publisher here."""
    from rclpy.event_handler import SubscriptionEventCallbacks

    return SubscriptionEventCallbacks(incompatible_qos=lambda event: say(_words(name, event, "this relay", "here")))


def _words(name: str, event: Any, reader: str, where: str) -> str:
    from rclpy.qos import QoSPolicyKind

    kind = QoSPolicyKind(int(event.last_policy_kind)).name
    asked, given = _PAIRS.get(kind, (f"another {kind.lower()}", "not so"))
    return f"{name}: {reader} gets nothing: it asks for {asked}, and a publisher {where} is {given}"
