"""Robofleet's Algorithm 3: a table of every kind of rule, and random rules against ten lines that say the same.

A hundred configurations in a commit; ten thousand nightly.
"""

import contextlib
import ipaddress
import itertools
import random
import re
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mutations import COUNT, SEED
from refusal_cases import refuse
from relay_cases import Corner, settings

from bufgym import cli
from bufgym.model.topics import Topic
from bufgym_relay import policies
from bufgym_relay.config import Config, Foxglove, Limits, Rotation, Rule, load
from bufgym_relay.hub import Hub
from bufgym_relay.outgoing import Outgoing
from bufgym_relay.plain import Latest
from bufgym_relay.quota import Bucket, Quotas
from bufgym_relay.rules import FOXGLOVE, RECORDER, Identity, Permissions, plain_address
from bufgym_relay.stored import StoredSession
from bufgym_relay.subscriber import Subscription, next_lane
from bufgym_robot.wire.messages import Message, RefusedError
from bufgym_robot.wire.patterns import MAX_CHARACTERS, pattern
from bufgym_robot.wire.queue import PolicyQueue

VERBS = ("send", "receive")


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
    assert Identity("10.0.0.7").key != Identity("10.0.0.8", "10.0.0.7").key  # an e-mail is nobody's address
    assert plain_address("::ffff:10.0.0.7") == "10.0.0.7"
    assert plain_address("fe80::1%eth0") == "fe80::1" and plain_address("::1") == "127.0.0.1"
    assert Permissions([Rule(address="::1", send=True)], Identity("127.0.0.1")).allow("send", "/a")


ADDRESSES = ["10.0.0.1", "10.0.0.2", "10.0.1.1", "192.168.0.1", "fd00::7", "fe80::7"]
RANGES = [*ADDRESSES, "10.0.0.0/24", "10.0.0.0/8", "0.0.0.0/0", "fd00::/8"]
EMAILS = ["a@x.org", "A@X.org", "b@x.org"]
OWN = [RECORDER, FOXGLOVE]
TOPICS = ["/a", "/b", "/a/b", "/a/c", "/ab", "/A"]
PATTERNS = [*TOPICS, "/a.*", "/[^/]+", ".*", "/a/(b|c)", "/a|/b", "a"]


def drawn(uniform: random.Random) -> list[Rule]:
    """Up to six rules."""
    known: list[dict[str, Any]] = [{"address": each} for each in RANGES] + [{"email": each} for each in EMAILS]
    known += [{who.own: True} for who in OWN]
    chosen = []
    for _ in range(uniform.randrange(7)):
        verb = uniform.choice([{"send": True}, {"receive": True}, {"send": True, "receive": True}])
        chosen.append(Rule(**uniform.choice(known), **verb, topic=uniform.choice(PATTERNS)))  # type: ignore[arg-type]
    return chosen


def reference(configuration: list[Rule], who: Identity, verb: str, topic: str) -> bool:
    for rule in configuration:
        if rule.address:
            known = not who.own and ipaddress.ip_address(who.address) in ipaddress.ip_network(rule.address)
        elif rule.email:
            known = rule.email.lower() == who.email.lower()
        else:
            known = who is (RECORDER if rule.recorder else FOXGLOVE)
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

    def offer(self, subscription: Subscription, outgoing: Outgoing) -> None:
        self.came.add(outgoing.message.topic)


def test_random_rules_as_the_reference() -> None:
    """What an identity may do, and what the relay then offers it of all that is published."""
    hub = Hub(settings())
    for k in range(COUNT):
        uniform = random.Random(f"{SEED}-rules-{k}")
        configuration = drawn(uniform)
        whos = [Identity(uniform.choice(ADDRESSES), uniform.choice(["", *EMAILS])) for _ in range(2)]
        whos.append(uniform.choice(OWN))
        ears = [Ear(str(n), configuration, who) for n, who in enumerate(whos)]
        for ear in ears:
            hub.join(ear)  # type: ignore[arg-type]
        for topic in TOPICS:
            hub.publish(None, Message(topic, b""))
        for ear in ears:
            hub.leave(ear)  # type: ignore[arg-type]
            who, every = ear.identity, list(itertools.product(VERBS, TOPICS))
            expected = {one for one in every if reference(configuration, who, *one)}
            assert {one for one in every if ear.permissions.allow(*one)} == expected, k  # type: ignore[arg-type]
            assert ear.came == {topic for verb, topic in expected if verb == "receive"}, k
    hub.close()


REPO = Path(__file__).resolve().parents[3]


def test_the_example_says_what_the_defaults_are(capsys: pytest.CaptureFixture[str]) -> None:
    example, default = load(REPO / "examples/relay.toml"), Config()
    names = set(Config.__struct_fields__) - {"rules", "folder", "tls", "tokens", "nats", "foxglove"}
    for name in names:
        assert getattr(example, name) == getattr(default, name), name
    assert example.folder == REPO / "examples" / "relay"
    assert len(example.rules) == 5 and default.rules == ()
    assert cli.main(["relay", "serve", "--config", str(REPO / "examples/relay.toml"), "--check"]) == 0
    assert "5 rules, 127.0.0.1:7420" in capsys.readouterr().out


def test_tables_and_files_beside_the_configuration(tmp_path: Path) -> None:
    path = tmp_path / "relay.toml"
    path.write_text(
        '[tls]\ncertificate = "a.pem"\nkey = "a.key"\n'
        '[tokens]\nissuer = "i"\naudience = "a"\nkeys = "k.json"\nalgorithms = ["ES256"]\n[audit]\nbytes = 5000\n'
        "[foxglove]\nport = 9000\n[[rules]]\nfoxglove = true\nreceive = true\n"
    )
    config = load(path)
    assert config.tls is not None and config.tokens is not None
    assert (config.tls.certificate, config.tls.key) == (str(tmp_path / "a.pem"), str(tmp_path / "a.key"))
    assert config.tls.clients == "" and config.tokens.keys == str(tmp_path / "k.json")
    assert config.audit == Rotation(bytes=5000)
    assert config.foxglove == Foxglove(port=9000) and config.rules == (Rule(foxglove=True, receive=True),)


# What waits for a subscriber, and that a slow one slows nobody.


def subscription(policy: str, capacity: int = 8, priority: float = 1.0) -> Subscription:
    return Subscription("a", pattern(".*"), policies.policy(policy), capacity, priority=priority)


def made(*subscriptions: Subscription) -> int:
    return sum(one.make() for one in subscriptions for _ in range(100))


def sent(*subscriptions: Subscription, now_s: float = 0.0) -> list[object]:
    """All that goes, one after the other, a second for each."""
    went = []
    made(*subscriptions)
    while (lane := next_lane(subscriptions, now_s)) is not None:
        item = lane.take(now_s)
        assert item is not None
        went.append(item.message)
        lane.gone()
        now_s += 1
    return went


WENT = {"drop-oldest": "034", "drop-newest": "012", "robofleet": "04", "skip-pending": "0"}
"""Of messages 0 to 4: the first is on its way at once; then the queue has room for two."""


@pytest.mark.parametrize(("policy", "went"), WENT.items())
def test_the_policy_decides(policy: str, went: str) -> None:
    one = subscription(policy, 2)
    for k in range(5):
        one.offer("/a", str(k), 10)
        made(one)
    assert len(one) == len(went) - 1 and one.dropped == 5 - len(went)
    assert sent(one) == list(went)
    one.offer("/a", "5", 10)
    assert sent(one) == ["5"]


@given(st.integers(1, 5), st.lists(st.integers(-2, 6), max_size=60))
def test_the_default_is_robofleets_rule(capacity: int, steps: list[int]) -> None:
    """Message for message: a step puts a message on a topic, or below 0 lets one go."""
    topics = tuple(Topic(f"/{k}") for k in range(policies.PLACES))
    both: tuple[Any, Any] = Latest(capacity), PolicyQueue("robofleet", capacity, topics=topics)
    for number, topic in enumerate(steps):
        if topic >= 0:
            for queue in both:
                queue.put(number, 10, topic=topic)
        elif both[0].in_flight:
            went = [queue.get(0).message for queue in both]
            assert went[0] == went[1]
            for queue in both:
                queue.gone()
        assert len({(len(queue), queue.dropped, queue.in_flight) for queue in both}) == 1


def test_topics_of_a_policy_that_knows_none_do_not_push_each_other_out() -> None:
    one = subscription("drop-oldest", 1)
    one.offer("/rare", "rare", 10)
    one.offer("/rare", "rare 2", 10)
    made(one)
    one.offer("/often", "first", 10)
    made(one)
    for k in range(100):
        one.offer("/often", k, 10)
    assert sorted(map(str, sent(one))) == ["99", "first", "rare", "rare 2"]


def test_priority_times_wait() -> None:
    """At second 0 both wait equally long: the first goes. Then 10 x 1 s is more than 1 x 2 s, and so on."""
    low, high = subscription("drop-oldest"), subscription("drop-oldest", priority=10)
    for k in range(3):
        low.offer("/low", f"low {k}", 10)
        high.offer("/high", f"high {k}", 10)
    assert sent(low, high, now_s=100) == ["high 0", "low 0", "high 1", "high 2", "low 1", "low 2"]


def test_queues_and_topics_are_bounded() -> None:
    one = subscription("skip-pending")
    for k in range(200):
        one.offer(f"/{k}", k, 10)
    assert len(one.lanes) == 64 and len(one._topics) == 64


def test_queues_are_made_in_turns_and_an_identity_has_only_so_many() -> None:
    """Five for two connections: 3 and 2. A publisher makes none of them, and each message arrives."""
    quotas, (one, other) = Quotas(Limits(queues=5), lambda: 0.0), (subscription("drop-oldest") for _ in "ab")
    with quotas.connection("a", {"a": one}), quotas.connection("a", {"a": other}):
        for each in (one, other):
            each.may_grow = partial(quotas.may_have_queue, "a", "")
        for k in range(8):
            for each in (one, other):
                each.offer(f"/{k}", k, 10)
    assert (len(one.lanes), len(other.lanes), one.make(), len(one.lanes)) == (0, 0, True, 1)
    assert (one.queues, other.queues, made(one, other)) == (3, 2, 4)
    assert sorted(sent(one)) == sorted(sent(other)) == list(range(8))


async def test_a_subscriber_that_reads_nothing_slows_nobody(corner: Corner) -> None:
    topic, before = corner.topic("camera"), corner.hub.status()["dropped"]
    async with corner.client() as robot, corner.client() as fast, corner.client(receive_buffer_bytes=16_384) as stuck:
        for one in (fast, stuck):
            await one.subscribe(f"^{topic}$", policy="robofleet")
        stuck.socket.transport.pause_reading()
        for k in range(20):
            await robot.put(topic, bytes(100_000), seq=k)
            assert (await fast.next()).seq == k
        dropped = corner.hub.status()["dropped"] - before
        assert dropped > 10
        stuck.socket.transport.resume_reading()
        # What the system had taken, and then the newest alone.
        numbers = [message.seq for message in await stuck.rest()]
        assert numbers == sorted(set(numbers)) and numbers[-1] == 19 and len(numbers) == 20 - dropped


def test_patterns_of_strangers_take_linear_time() -> None:
    evil = pattern("(a+)+$")
    assert evil.part("/" + "a" * 200) and not evil.part("/" + "a" * 200 + "b")
    assert pattern("^/a$").part("/a") and not pattern("^/a$").part("/ab")
    assert pattern("/a").part("x/ab") and not pattern("/a").whole("x/ab")
    for text in ("(", "a" * (MAX_CHARACTERS + 1), r"(a)\1", r"\pL{500}", "\ud800"):
        refuse("pattern", pattern, text)


def test_a_bucket_of_ten_a_second() -> None:
    bucket = Bucket(10)
    assert [bucket.take(4, 0.0) for _ in range(3)] == [True, True, False]
    assert not bucket.take(4, 0.1) and bucket.take(4, 0.2)  # 2 left, 3, 4
    # More than a second's worth waits for a full bucket, and is paid for.
    assert bucket.take(25, 5.0) and not bucket.take(1, 6.5) and bucket.take(1, 6.7)


def test_quotas_are_remembered_for_a_while() -> None:
    now_s = 0.0
    quotas = Quotas(Config().limits, lambda: now_s)
    with quotas.connection("a", {}) as quota:
        now_s = 100.0
        quotas.tidy()
        assert quotas.of("a") is quota
    quotas.tidy()
    assert quotas.of("a") is quota
    now_s = 161.0
    quotas.tidy()
    assert quotas.of("a") is not quota
