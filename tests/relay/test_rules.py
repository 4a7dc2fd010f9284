"""Robofleet's Algorithm 3: a table of every kind of rule, and random rules against ten lines that say the same.

Some hundred configurations every day; ``BUFGYM_FUZZ=100000`` is the full count.
"""

from __future__ import annotations

import ipaddress
import random
import re

import pytest
from mutations import COUNT, SEED
from relay_cases import client, relay, run, settings

from bufgym.errors import BufgymError
from bufgym.relay import policies
from bufgym.relay.config import Rule
from bufgym.relay.hub import Frame, Hub
from bufgym.relay.patterns import pattern
from bufgym.relay.rules import FOXGLOVE, RECORDER, Identity, Permissions, plain_address
from bufgym.relay.store import Session
from bufgym.relay.subscriber import Subscription
from bufgym.relay.wire import Message

IDENTITIES = {
    "address": (Rule(address="10.0.0.7", send=True), Identity("10.0.0.7"), Identity("10.0.0.8")),
    "range": (Rule(address="10.0.0.0/24", send=True), Identity("10.0.0.7"), Identity("10.0.1.7")),
    "address 6": (Rule(address="fd00::/8", send=True), Identity("fd00::7"), Identity("fe80::7")),
    "email": (Rule(email="A@x.org", send=True), Identity("1.2.3.4", "a@X.org"), Identity("1.2.3.4", "b@x.org")),
    "no email": (Rule(email="a@x.org", send=True), Identity("1.2.3.4", "a@x.org"), Identity("1.2.3.4")),
    "recorder": (Rule(recorder=True, send=True), RECORDER, Identity("10.0.0.7")),
    "foxglove": (Rule(foxglove=True, send=True), FOXGLOVE, RECORDER),
    "all but it": (Rule(address="0.0.0.0/0", send=True), Identity("10.0.0.7"), RECORDER),
}


@pytest.mark.parametrize("kind", IDENTITIES)
@pytest.mark.parametrize("verb", ["send", "receive"])
@pytest.mark.parametrize("topic", ["/a/b", "/a/bc", "/x/a/b", "/a/B"])
def test_each_kind_of_rule(kind: str, verb: str, topic: str) -> None:
    """Allowed is this identity, this verb, this whole topic; everything else is denied."""
    rule, who, other = IDENTITIES[kind]
    fields = {name: getattr(rule, name) for name in ("address", "email", "recorder", "foxglove")}
    for allowed in ("send", "receive"):
        rules = [Rule(**fields, **{allowed: True}, topic="/a/b")]  # type: ignore[arg-type]
        assert Permissions(rules, who).allow(verb, topic) == (verb == allowed and topic == "/a/b")  # type: ignore[arg-type]
        assert not Permissions(rules, other).allow(verb, topic)  # type: ignore[arg-type]
    assert not Permissions([], who).allow(verb, topic)  # type: ignore[arg-type]


def test_addresses_are_taken_as_they_are_meant() -> None:
    assert plain_address("::ffff:10.0.0.7") == "10.0.0.7"
    assert plain_address("fe80::1%eth0") == "fe80::1"


@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"send": True}, "needs one identity"),
        ({"address": "10.0.0.1", "email": "a@x.org", "send": True}, "needs one identity"),
        ({"recorder": True, "foxglove": True, "send": True}, "needs one identity"),
        ({"address": "10.0.0.1"}, "must allow send or receive"),
        ({"address": "10.0.0.1/8", "send": True}, "has host bits set"),
        ({"address": "robot", "send": True}, "does not appear to be"),
        ({"email": "a@x.org", "send": 1}, "must be true or false"),
        ({"email": "a@x.org", "send": True, "topic": "(a"}, "pattern '(a': missing )"),
        ({"email": "a@x.org", "send": True, "topic": r"(a)\1"}, "invalid escape sequence"),
    ],
)
def test_a_rule_that_says_nothing_clear(fields: dict[str, object], error: str) -> None:
    with pytest.raises(BufgymError, match=re.escape(error)):
        Rule(**fields)  # type: ignore[arg-type]


# --- random configurations -------------------------------------------------------------------------------------------

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
        self.session = Session(name, identity, temporary=True)
        self.permissions = Permissions(configuration, identity)
        self.subscriptions = {"a": Subscription("a", pattern(".*"), policies.policy("drop-oldest"), 1)}
        self.came: set[str] = set()

    def offer(self, subscription: Subscription, frame: Frame) -> None:
        self.came.add(frame.message.topic)


def test_random_rules_as_the_reference() -> None:
    """What an identity may do, and what the relay then offers it of all that is published."""
    hub = Hub(settings())
    for k in range(COUNT):
        uniform = random.Random(f"{SEED}-rules-{k}")
        configuration = drawn(uniform)
        ears = [
            Ear(str(n), configuration, Identity(uniform.choice(ADDRESSES), uniform.choice(["", *EMAILS])))
            for n in range(2)
        ]
        for ear in ears:
            hub.join(ear)  # type: ignore[arg-type]
        for topic in TOPICS:
            hub.publish(None, Message(topic, b""))
        for ear in ears:
            hub.leave(ear)  # type: ignore[arg-type]
            who = ear.identity
            expected = {
                (verb, topic)
                for verb in ("send", "receive")
                for topic in TOPICS
                if reference(configuration, who.address, who.email, verb, topic)
            }
            allowed = {
                (verb, topic)
                for verb in ("send", "receive")
                for topic in TOPICS
                if ear.permissions.allow(verb, topic)  # type: ignore[arg-type]
            }
            assert allowed == expected, k
            assert ear.came == {topic for verb, topic in expected if verb == "receive"}, k
    hub.close()


@pytest.mark.parametrize("seed", range(max(2, COUNT // 1_000)))
def test_nothing_is_delivered_that_no_rule_allows(seed: int) -> None:
    """On sockets: of what each of three clients sends, each other gets exactly what the reference lets through."""
    uniform = random.Random(seed)
    addresses = ["127.0.0.1", "127.0.0.2", "127.0.0.3"]
    places = [*addresses, "127.0.0.0/30", "127.0.0.0/8"]
    configuration = [Rule(address=each, send=True, topic="/open") for each in addresses]
    for _ in range(5):
        send = uniform.random() < 0.5
        place, topic = uniform.choice(places), uniform.choice(PATTERNS)
        configuration.append(Rule(address=place, send=send, receive=not send, topic=topic))

    async def story() -> None:
        async with (
            relay(settings(rules=tuple(configuration))) as server,
            client(server.port, local=addresses[0]) as a,
            client(server.port, local=addresses[1]) as b,
            client(server.port, local=addresses[2]) as c,
        ):
            clients = dict(zip(addresses, (a, b, c), strict=True))
            for one in clients.values():
                assert (await one.subscribe(".*", capacity=100))["op"] == "subscribed"
            for sender, topic in ((sender, topic) for sender in addresses for topic in TOPICS):
                await clients[sender].put(topic, sender.encode())
            for receiver in addresses:
                came = set()
                while True:
                    try:
                        said = await clients[receiver].next(0.1)
                    except TimeoutError:
                        break
                    if isinstance(said, tuple):
                        came.add((bytes(said.payload).decode(), said.topic))
                assert came == {
                    (sender, topic)
                    for sender in addresses
                    for topic in TOPICS
                    if sender != receiver
                    and reference(configuration, sender, "", "send", topic)
                    and reference(configuration, receiver, "", "receive", topic)
                }

    run(story)
