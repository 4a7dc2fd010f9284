"""Permissions by Robofleet's Algorithm 3: whatever no rule allows is denied.

for each rule of the identity, by address, address range or e-mail: if the rule allows the verb, and its pattern matches
    the whole topic: allowed
denied
"""

import ipaddress
import math
import string
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from bufgym_relay.config import Rule
from bufgym_robot.wire.messages import RefusedError
from bufgym_robot.wire.orders import COMMAND_S, right
from bufgym_robot.wire.patterns import pattern, topic_of

Verb = Literal["send", "receive"]
_REMEMBERED: Final = 4_096  # answers cached for one identity


_CAPITALS: Final = str.maketrans(string.ascii_uppercase, string.ascii_lowercase)


def folded(email: str) -> str:
    """Fold the letters of ASCII; others stay, as ``lower`` would make a k of the sign of Kelvin."""
    return email.translate(_CAPITALS)


@dataclass(frozen=True)
class Identity:
    """Proven identity of the other end of a connection."""

    address: str = ""
    email: str = ""  # E-mail of a verified token or certificate
    own: str = ""  # the relay's own part, as in ``Rule.own``
    until_s: float = math.inf  # end of its token, s since 1970

    @property
    def key(self) -> str:
        """Key under which limits are counted."""
        return f"<{folded(self.email)}>" if self.email else self.address  # no address reads so

    def as_json(self) -> dict[str, Any]:
        """Return the fields that others may see."""
        return {"address": self.address, "email": self.email}


RECORDER, FOXGLOVE = Identity(own="recorder"), Identity(own="foxglove")
NATS = Identity(email="\0nats", own="nats")
"""The other relays. No client can prove an e-mail with a character that does not print."""


def plain_address(text: str) -> str:
    """Normalize an address for rules: unwrap IPv4 in IPv6, as in ``::ffff:10.0.0.1``, and strip a scope.

    This machine is 127.0.0.1, whichever way ``localhost`` was resolved.
    """
    address = ipaddress.ip_address(text.partition("%")[0])
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return "127.0.0.1" if str(address) == "::1" else str(mapped or address)


def means(rule: Rule, identity: Identity) -> bool:
    """Whether the rule is for this identity."""
    if rule.own or identity.own:
        return rule.own == identity.own
    if rule.email:
        return folded(rule.email) == folded(identity.email)
    return ipaddress.ip_address(identity.address) in ipaddress.ip_network(
        "127.0.0.1" if rule.address == "::1" else rule.address
    )


class Permissions:
    """Permissions of one identity."""

    def __init__(self, rules: Sequence[Rule], identity: Identity) -> None:
        self.rules = tuple(rule for rule in rules if means(rule, identity))
        self._answers: dict[tuple[Verb, str], bool] = {}
        self._command_s: dict[str, float] = {}

    def allow(self, verb: Verb, topic: str) -> bool:
        """Whether a rule allows this on the topic."""
        topic = right(topic)
        answer = self._answers.get((verb, topic))
        if answer is None:
            answer = any(getattr(rule, verb) and pattern(rule.topic).whole(topic) for rule in self.rules)
            if len(self._answers) >= _REMEMBERED:
                self._answers.clear()
            self._answers[verb, topic] = answer
        return answer

    def command_s(self, topic: str) -> float:
        """Give the time for which a command on this topic may be executed, by the first rule that lets it be sent."""
        topic = right(topic)
        answer = self._command_s.get(topic)
        if answer is None:
            found = (rule.command_s for rule in self.rules if rule.send and pattern(rule.topic).whole(topic))
            answer = next(found, COMMAND_S)
            if len(self._command_s) >= _REMEMBERED:
                self._command_s.clear()
            self._command_s[topic] = answer
        return answer

    def speed(self, topic: str) -> float:
        """Give the largest velocity on this topic, m/s and rad/s, by the first rule that lets it be sent."""
        return next((rule.speed for rule in self.rules if rule.send and pattern(rule.topic).whole(topic)), 0.0)

    @property
    def receives(self) -> bool:
        """Whether a rule allows to receive anything."""
        return any(rule.receive for rule in self.rules)

    def check_subscription(self, text: str) -> None:
        """Ask the rules before a subscription (Algorithm 3, line 9); each message is asked for again.

        A pattern of one whole topic, ``^/a/b$``, needs a rule for it. Others need a rule that lets receive anything.

        Raises RefusedError: there is none.
        """
        if (topic := topic_of(text)) is not None:
            if not self.allow("receive", topic):
                raise RefusedError("unauthorized", f"topic {topic}: no rule allows to receive it")
        elif not self.receives:
            raise RefusedError("unauthorized", "no rule allows to receive anything")
