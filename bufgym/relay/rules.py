"""Who may do what: Robofleet's Algorithm 3. Denied is all that no rule allows.

for each rule of the identity (its address, a range that holds it, its e-mail):
    if the rule allows the verb, and its pattern matches the whole topic: allowed
denied
"""

from __future__ import annotations

import ipaddress
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

from bufgym.relay.config import Rule
from bufgym.relay.patterns import pattern

Verb = Literal["send", "receive"]
_REMEMBERED: Final = 4_096
"""Answers that are kept of one identity."""


@dataclass(frozen=True)
class Identity:
    """Who is at the other end of a connection, as far as that is proven."""

    address: str = ""
    email: str = ""
    """Of a token or a certificate that was verified."""
    own: str = ""
    """One of the relay's own, as ``Rule.own``."""
    until_s: float = math.inf
    """Its token ends then, s since 1970."""

    @property
    def key(self) -> str:
        """What limits are counted by."""
        return self.email or self.address

    def as_json(self) -> dict[str, Any]:
        """Without what is its own business."""
        return {name: value for name, value in asdict(self).items() if name in ("address", "email")}


RECORDER, FOXGLOVE = Identity(own="recorder"), Identity(own="foxglove")


def plain_address(text: str) -> str:
    """An IPv4 address that came over IPv6 (``::ffff:10.0.0.1``), and an address with a scope, as rules have them."""
    address = ipaddress.ip_address(text.partition("%")[0])
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return str(mapped or address)


def means(rule: Rule, identity: Identity) -> bool:
    """Whether the rule's identity is this one."""
    if rule.own or identity.own:
        return rule.own == identity.own
    if rule.email:
        return rule.email.lower() == identity.email.lower()
    return ipaddress.ip_address(identity.address) in ipaddress.ip_network(rule.address)


class Permissions:
    """What one identity may do."""

    def __init__(self, rules: Sequence[Rule], identity: Identity) -> None:
        self.rules = tuple(rule for rule in rules if means(rule, identity))
        self._answers: dict[tuple[Verb, str], bool] = {}

    def allow(self, verb: Verb, topic: str) -> bool:
        """Whether a rule allows it."""
        answer = self._answers.get((verb, topic))
        if answer is None:
            answer = any(getattr(rule, verb) and pattern(rule.topic).whole(topic) for rule in self.rules)
            if len(self._answers) >= _REMEMBERED:
                self._answers.clear()
            self._answers[verb, topic] = answer
        return answer
