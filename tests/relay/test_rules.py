"""Robofleet's Algorithm 3: a table of every kind of rule, and random rules against ten lines that say the same.

A hundred configurations in a commit; ten thousand in the night.
"""

import contextlib
import ipaddress
import itertools
import random
import re

import pytest
from mutations import COUNT, SEED
from relay_cases import settings

from bufgym.relay import policies
from bufgym.relay.config import Rule
from bufgym.relay.hub import Hub, Outgoing
from bufgym.relay.patterns import pattern
from bufgym.relay.rules import FOXGLOVE, RECORDER, Identity, Permissions, plain_address
from bufgym.relay.store import StoredSession
from bufgym.relay.subscriber import Subscription
from bufgym.relay.wire import Message, RefusedError

VERBS = ("send", "receive")


@pytest.mark.parametrize(
    ("known", "who", "other"),
    [
        ({"address": "10.0.0.7"}, Identity("10.0.0.7"), Identity("10.0.0.8")),
        ({"address": "10.0.0.0/24"}, Identity("10.0.0.7"), Identity("10.0.1.7")),
        ({"address": "fd00::/8"}, Identity("fd00::7"), Identity("fe80::7")),
        ({"email": "A@x.org"}, Identity("1.2.3.4", "a@X.org"), Identity("1.2.3.4", "b@x.org")),
        ({"email": "a@x.org"}, Identity("1.2.3.4", "a@x.org"), Identity("1.2.3.4")),
        ({"recorder": True}, RECORDER, Identity("10.0.0.7")),
        ({"foxglove": True}, FOXGLOVE, RECORDER),
        ({"address": "0.0.0.0/0"}, Identity("10.0.0.7"), RECORDER),
    ],
)
def test_each_kind_of_rule(known: dict[str, object], who: Identity, other: Identity) -> None:
    """Allowed is this identity, this verb, this whole topic; everything else is denied."""
    for verb, allowed, topic in itertools.product(VERBS, VERBS, ("/a/b", "/a/bc", "/x/a/b", "/a/B")):
        rules = [Rule(**known, **{allowed: True}, topic="/a/b")]  # type: ignore[arg-type]
        assert Permissions(rules, who).allow(verb, topic) == (verb == allowed and topic == "/a/b")  # type: ignore[arg-type]
        assert not Permissions(rules, other).allow(verb, topic)  # type: ignore[arg-type]
        assert not Permissions([], who).allow(verb, topic)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "allowed"),
    [("^/a/b$", True), ("^/a/c$", False), ("^/a/.$", True), ("/a/c", True), ("^/a/c", True), ("^", True), ("", True)],
)
def test_rules_are_asked_before_a_subscription(text: str, allowed: bool) -> None:
    """Patterns of one whole topic like a message on it; others pass where anything at all may be received."""
    mine, sender = Rule(address="10.0.0.7", receive=True, topic="/a/b"), Rule(address="10.0.0.7", send=True)
    with contextlib.nullcontext() if allowed else pytest.raises(RefusedError, match="topic /a/c: no rule allows"):
        Permissions([mine], Identity("10.0.0.7")).check_subscription(text)
    with pytest.raises(RefusedError, match="no rule allows to receive"):
        Permissions([sender], Identity("10.0.0.7")).check_subscription(text)


def test_addresses_are_taken_as_they_are_meant() -> None:
    assert plain_address("::ffff:10.0.0.7") == "10.0.0.7"
    assert plain_address("fe80::1%eth0") == "fe80::1"


ADDRESSES = ["10.0.0.1", "10.0.0.2", "10.0.1.1", "192.168.0.1"]
RANGES = [*ADDRESSES, "10.0.0.0/24", "10.0.0.0/8", "0.0.0.0/0"]
EMAILS = ["a@x.org", "b@x.org"]
TOPICS = ["/a", "/b", "/a/b", "/a/c", "/ab"]
PATTERNS = [*TOPICS, "/a.*", "/[^/]+", ".*", "/a/(b|c)", "/a|/b", "a"]


def drawn(uniform: random.Random) -> list[Rule]:
    """Up to six rules."""
    known: list[dict[str, str]] = [{"address": each} for each in RANGES] + [{"email": each} for each in EMAILS]
    chosen = []
    for _ in range(uniform.randrange(7)):
        verb = uniform.choice([{"send": True}, {"receive": True}, {"send": True, "receive": True}])
        chosen.append(Rule(**uniform.choice(known), **verb, topic=uniform.choice(PATTERNS)))  # type: ignore[arg-type]
    return chosen


def reference(configuration: list[Rule], address: str, email: str, verb: str, topic: str) -> bool:
    for rule in configuration:
        if rule.address:
            known = ipaddress.ip_address(address) in ipaddress.ip_network(rule.address)
        else:
            known = rule.email == email
        verbs = {"send": rule.send, "receive": rule.receive}
        if known and verbs[verb] and re.fullmatch(rule.topic, topic):
            return True
    return False


class Ear:
    """A ``hub.Member`` that wants all there is."""

    acks, sent = False, 0

    def __init__(self, name: str, configuration: list[Rule], identity: Identity) -> None:
        self.identity = identity
        self.session = StoredSession(name, identity, temporary=True)
        self.permissions = Permissions(configuration, identity)
        self.subscriptions = {"a": Subscription("a", pattern(".*"), policies.policy("drop-oldest"), 1)}
        self.came: set[str] = set()

    def offer(self, subscription: Subscription, frame: Outgoing) -> None:
        self.came.add(frame.message.topic)


def test_random_rules_as_the_reference() -> None:
    """What an identity may do, and what the relay then offers it of all that is published."""
    hub = Hub(settings())
    for k in range(COUNT):
        uniform = random.Random(f"{SEED}-rules-{k}")
        configuration = drawn(uniform)
        whos = [Identity(uniform.choice(ADDRESSES), uniform.choice(["", *EMAILS])) for _ in range(2)]
        ears = [Ear(str(n), configuration, who) for n, who in enumerate(whos)]
        for ear in ears:
            hub.join(ear)  # type: ignore[arg-type]
        for topic in TOPICS:
            hub.publish(None, Message(topic, b""))
        for ear in ears:
            hub.leave(ear)  # type: ignore[arg-type]
            who, every = ear.identity, list(itertools.product(VERBS, TOPICS))
            expected = {one for one in every if reference(configuration, who.address, who.email, *one)}
            assert {one for one in every if ear.permissions.allow(*one)} == expected, k  # type: ignore[arg-type]
            assert ear.came == {topic for verb, topic in expected if verb == "receive"}, k
    hub.close()
