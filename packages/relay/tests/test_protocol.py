"""What both ends decide, without sockets: when to try again, and what a frame leads to."""

import contextlib
import json
import random
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Raw
from refusal_cases import refuse
from relay_cases import settings

from bufgym.policies import registry
from bufgym.utils.errors import BufgymError
from bufgym_relay import protocol
from bufgym_relay.config import Config, Limits, Rule
from bufgym_relay.protocol import check_json
from bufgym_relay.quota import Quota, Quotas
from bufgym_relay.rules import Identity, Permissions
from bufgym_relay.stored import StoredSession
from bufgym_robot.wire import backoff
from bufgym_robot.wire import messages as wire
from bufgym_robot.wire.backoff import Backoff
from bufgym_robot.wire.messages import Message, RefusedError, WireError
from bufgym_robot.wire.patterns import for_client, pattern
from bufgym_robot.wire.session import Session


def test_tries_spread_out_and_begin_anew_after_a_connection_that_held() -> None:
    """At most 0.2 s, twice as long each time, at most 8 s, and 1 s if nobody answers; no two clients agree."""
    now_s, drawn = 0.0, random.Random(3)
    one, other = (Backoff(random.Random(seed), lambda: now_s) for seed in (3, 4))
    for most_s in (0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 8.0, 8.0, 1.0):
        away = most_s == 1.0
        assert one.delay_s(away) == drawn.uniform(0.0, most_s) != other.delay_s()
    for held_s, most_s in ((backoff.HELD_S - 0.1, 8.0), (backoff.HELD_S, 0.2), (0.0, 0.4)):
        one.connected()
        now_s += held_s
        assert one.delay_s() == drawn.uniform(0.0, most_s)
    now_s += 100.0  # no connection held, however long the tries took
    assert one.delay_s() == drawn.uniform(0.0, 0.8)


ANNA = Identity("10.0.0.7", "anna@x.org")
RULES = (Rule(address="10.0.0.0/8", send=True, receive=True, topic="/open/.*"),)
CONFIG = settings(rules=RULES)


def test_a_hello_that_is_refused() -> None:
    def begin(first: str | bytes) -> None:
        protocol.admit(protocol.hello(first), ANNA, RULES, "fresh")

    refuse("a binary frame: must be hello first", begin, b"\x00", kind=WireError)
    refuse("ack: must be hello first", begin, wire.say("ack", seq=1), kind=WireError)
    for version, more, error in (
        (9, {}, "must be of version 1, of form binary or json"),
        (1, {"form": "xml"}, "must be of version 1, of form binary or json"),
        (1, {"session": "a b"}, "session = 'a b': must be 1 to 64 letters"),
        (1, {"name": "relay"}, "name = 'relay': must be a name, not the relay's"),
        (1, {"received": 2**53}, r"received, acked = \(9007199254740992, 0\): must be less than 9007199254740992"),
        (1, {"name": "\n"}, "name '\\\\n': must be printable"),
    ):
        refuse(f"hello: {error}", begin, wire.say("hello", version=version, **more), kind=WireError)


def test_who_is_let_in_and_welcomed() -> None:
    said = protocol.hello(wire.say("hello", version=1, session="a", received=3, acked=2))
    admitted = protocol.admit(said, ANNA, RULES, "fresh")
    assert admitted[1:] == ("anna@x.org", "a", False, "binary", 3, 2, "", (), {})
    plain = protocol.admit({"name": "n", "form": "json"}, ANNA, RULES, "fresh")
    assert plain[1:] == ("n", "fresh", True, "json", 0, 0, "", (), {})
    welcome = protocol.welcome(CONFIG, admitted, ANNA, 5, 7)
    assert wire.heard(wire.say("welcome", **welcome))["received"] == 5 and welcome["session"] == "a"
    assert welcome["rules"] == [{"send": True, "receive": True, "topic": "/open/.*", "command_s": 3.0}]
    refuse("no rule allows anything", protocol.admit, said, Identity("11.0.0.1"), RULES, "fresh", kind=RefusedError)


def test_what_a_frame_asks() -> None:
    message = Message("/open/a", b'{"x":1}', seq=2, no_drop=True)
    assert protocol.asked(wire.encode(message), 100) == message
    assert protocol.asked(wire.say("publish", topic="/open/a", data={"x": 1}, seq=2, no_drop=True), 0) == message
    assert protocol.asked(wire.say("ack", seq=1), 0) == {"op": "ack", "seq": 1}
    refuse("frame of 50 bytes: must be from 32 to 40", protocol.asked, wire.encode(message), 40, kind=WireError)
    hello = wire.say("hello", version=1)
    refuse("hello: must be one of subscribe, unsubscribe", protocol.asked, hello, 40, kind=WireError)
    refuse("text of 2097152 characters", protocol.asked, "x" * 2**21, 40, kind=WireError)
    long = wire.say("unsubscribe", id="a" * 2**16)  # only what is published may be so long
    refuse("unsubscribe: .* must be at most 65536", protocol.asked, long, 40, kind=WireError)


def test_which_messages_are_taken() -> None:
    """Topics under /open/, of which at most two; command is no_drop, and 1 to 3 of its messages were taken."""
    limits = Limits(topics=2, messages_per_s=9)
    permissions, quota = Permissions(RULES, ANNA), Quota(limits, 0.0)

    def code(message: Message) -> bool | str:
        no_drop = message.topic.endswith("command")
        try:
            return protocol.check(message, StoredSession("a", Identity(), False, 3), permissions, quota, no_drop, 0.0)
        except RefusedError as refused:
            return refused.code

    command = Message("/open/command", b"1", seq=3, no_drop=True)
    assert code(command) is False and code(command._replace(seq=4)) is True
    assert code(command._replace(seq=5)) == code(command._replace(seq=0)) == "out_of_order"
    assert code(command._replace(no_drop=False)) == code(Message("/open/a", b"{")) == "wrong"
    assert code(Message("/shut", b"1")) == code(Message("/relay/status", b"1")) == "unauthorized"
    assert code(Message("/open/b", b"1")) == "too_many" and code(Message("/open/a", b"{", "raw")) is True
    assert code(Message("/open/a", b"1")) == "too_fast" and code(command) is False


def test_a_subscription_that_is_refused() -> None:
    for name, wrong, error in (
        *(("topic", "(", "pattern"), ("capacity", 0, "capacity"), ("id", "\n", "id")),
        ("policy", "afr", "policy 'afr': must be one of drop-oldest"),
        ("priority", -1, "priority = -1.0: must be from 0 to 1e"),
        ("durable", True, "durable: needs a session of a name"),
    ):
        policy = None if name == "policy" else registry.get("drop-oldest")
        asked = {"id": "a", "topic": "a", name: wrong}
        refuse(error, protocol.subscription, asked, CONFIG, policy, True, lambda: 0)


def test_a_quota_counts_what_its_connections_have() -> None:
    """Two connections and four subscriptions at most, of which a long pattern counts for two.

    A connection that fails gives back what it had.
    """
    quotas, short = Quotas(Limits(connections=2, subscriptions=4), lambda: 0.0), pattern("^/a$")
    x, y, z = (SimpleNamespace(pattern=pattern(text)) for text in ("^/x$", "^/y$", "/[^/]+/[^/]+/[^/]+/y"))
    with contextlib.suppress(ValueError), quotas.connection("a", {"x": x, "y": y}) as quota:
        quota.subscribe("z", {}, z.pattern.cost)
        with quotas.connection("a", {"z": z}) as same, pytest.raises(RefusedError, match="at most 4 subscriptions"):
            assert same is quota
            quota.subscribe("x", {"x": x}, short.cost)  # it replaces one
            quota.subscribe("w", {"z": z}, short.cost)
        with quotas.connection("a", {}), pytest.raises(RefusedError, match="at most 2 connections"):
            quotas.connection("a", {}).__enter__()
        raise ValueError
    assert quota.connections == []


# Frames byte by byte, and what is none.

names = st.text(st.characters(exclude_categories=("C", "Z")), max_size=60)
NO_JSON = (
    b"{",
    b"1e400",
    b"[-1E+999]",
    b"NaN",
    b"-Infinity",
    b'"\xff"',
    "1".encode("utf-16"),
    b"[" * 10_000,
    b"9" * 5_000,
    b"1" + b"0" * 249 + b"e99",
)
whole, stamps = st.integers(0, 2**53), st.integers(-(2**53), 2**53)
messages = st.builds(
    Message,
    names.map("/{}".format),
    st.binary(max_size=50),
    st.just("raw"),
    names,
    names,
    whole,
    stamps,
    st.booleans(),
    whole,
    whole,
    whole,
    names,
)


def test_byte_by_byte() -> None:
    message = Message("/a/b", b"\x01\x02", "jpeg", "T", "me", seq=258, stamp_us=-1, no_drop=True)
    assert wire.encode(message) == (
        b"bR\x01\x01\x01\x04\x01\x04\x02\0\0\0"
        b"\0\0\0\x02"
        b"\0\0\0\0\0\0\x01\x02"
        b"\xff\xff\xff\xff\xff\xff\xff\xff"
        b"/a/bTjpegme\x01\x02"
    )
    timed = wire.encode(message._replace(at_us=259, until_us=260))
    assert timed[4] == 3 and timed[32:] == b"\0\0\0\0\0\0\x01\x03\0\0\0\0\0\0\x01\x04" + wire.encode(message)[32:]


def published(text: str) -> Message:
    return wire.from_json(wire.heard(text.replace("message", "publish", 1)))


@given(messages)
def test_what_is_written_is_read(message: Message) -> None:
    assert wire.decode(wire.encode(message)) == message
    assert published(wire.to_json(message)) == message._replace(sender="", at_us=0, number=0, seen="")


@pytest.mark.parametrize("payload", NO_JSON, ids=len)
def test_a_payload_that_is_no_json_is_refused(payload: bytes) -> None:
    with pytest.raises(RefusedError, match="topic /a: payload must be JSON"):
        check_json(Message("/a", payload))
    check_json(Message("/a", b'["1e400", 1e99, 1e-400, "' + 400 * b"9" + b'"]'))


def test_json_payloads_are_values() -> None:
    """No Python objects are made of them in the relay: they take long, and are as many as their sender likes."""
    assert isinstance(wire.heard('{"op":"publish","topic":"/a","data":[1]}')["data"], Raw)
    message = Message("/a", b'{"x": [1, null, "\\u00e4"]}')
    assert json.loads(wire.to_json(message))["data"] == {"x": [1, None, "ä"]}
    assert json.loads(bytes(published(wire.to_json(message)).payload)) == {"x": [1, None, "ä"]}


GOOD = wire.encode(Message("/a", b"12"))
TWO = {2: "version 1", 3: "kind 1", 4: "frame of 40 bytes: must be at least 48"}
"""What a 2 at this place breaks."""


@pytest.mark.parametrize(
    ("read", "given", "error"),
    [
        (wire.decode, b"", "frame of 0 bytes"),
        (wire.decode, GOOD[:-1], "frame of 39 bytes: must be 40"),
        (wire.decode, GOOD + b"1", "frame of 41 bytes: must be 40"),
        *((wire.decode, data, "header") for data in (b"bX" + GOOD[2:], GOOD[:9] + b"\x01" + GOOD[10:])),
        *((wire.decode, GOOD[:k] + b"\x02" + GOOD[k + 1 :], says) for k, says in TWO.items()),
        (wire.decode, GOOD[:4] + b"\x08" + GOOD[5:], "a known flag"),
        (wire.decode, GOOD[:16] + b"\xff" * 8 + GOOD[24:], "seq"),
        (wire.decode, GOOD[:24] + b"\x7f" + GOOD[25:], "stamp_us"),
        (wire.decode, GOOD.replace(b"/a", b"aa"), "must begin with '/'"),
        (wire.decode, GOOD.replace(b"/a", b"/\n"), "must be printable"),
        (wire.decode, GOOD.replace(b"/a", b"/\xff"), "must be UTF-8"),
        (wire.heard, "", "must be JSON"),
        *((wire.heard, text, "must be an object") for text in ("[" * 10_000, "9" * 5_000)),
        (wire.heard, "3", "must be an object"),
        *((wire.heard, text, "must be an object whose op") for text in ('{"op": "dance"}', '{"op": ["hello"]}')),
        (wire.heard, '{"op": "hello"}', "missing required field `version`"),
        (wire.heard, '{"op": "hello", "version": true}', "Expected `int`, got `bool`"),
        (wire.heard, '{"op": "hello", "version": -1}', "Expected `int` >= 0"),
        (wire.heard, '{"op": "hello", "version": 1e99}', "Expected `int`, got `float`"),
        (wire.heard, '{"op": "publish", "topic": "/a", "data": NaN}', "must be JSON: .* invalid character"),
        (wire.heard, '{"op": "subscribe", "id": "a", "topic": 3}', r"Expected `str`, got `int` - at `\$.topic`"),
        (wire.heard, '{"op": "subscribe", "id": "a", "topic": "a", "priority": "1"}', "Expected `float`, got `str`"),
        (wire.from_json, {"topic": "a", "data": 1}, "must begin with '/'"),
        (wire.from_json, {"topic": "/\ud800", "data": 1}, "must be"),
        *((wire.from_json, {"topic": f"/{name}", "data": 1}, "at most 255 bytes") for name in ("a" * 255, "ä" * 128)),
        *(
            (wire.from_json, {"topic": "/a", "encoding": "jpeg", "data": data}, "must be base64")
            for data in (b'"*"', b"3")
        ),
        (wire.from_json, {"topic": "/a", "encoding": "", "data": b'""'}, "must not be empty"),
        (wire.heard, '{"op": "ack", "seq": -1e400}', "-1e400: numbers must be finite|out of range"),
    ],
)
def test_each_fault_is_named(read: Any, given: Any, error: str) -> None:
    with pytest.raises(WireError, match=error):
        read(given)


UNLIKE = [
    r"\pL+", "(?U)a", r"\z", r"\Aa", "[[:alnum:]-]+", "[a[:alpha:]]", "[]a]", "[a--b]", "a++", "a*+", "a{,3}",
    "(?P<a>b)", "(?i)a", "(?=a)", r"\x{61}", "a**",
]  # fmt: skip


@pytest.mark.parametrize("text", UNLIKE)
def test_no_pattern_is_taken_that_clients_read_otherwise(text: str) -> None:
    refuse("pattern", pattern, text)
    refuse("pattern", Session("ws://a:1", "a").subscribe, text, print)
    refuse("pattern", Config, no_drop=(text,))


PIECES = [
    *"a-^$.*+?|()[]{},2:&~é", r"\d", r"\w", r"\W", r"\b", r"\]", r"\[", r"\\", r"\.", r"\pL", r"\z", r"\A", "(?:",
    "(?i)", "[:", ":]", "{2}", "{,2}", "[^",
]  # fmt: skip


@given(st.lists(st.sampled_from(PIECES), max_size=8).map("".join), st.lists(st.text("a-^2:&~é[]\\ .,{|", max_size=4)))
def test_what_is_taken_means_the_same_to_all(text: str, topics: list[str]) -> None:
    with contextlib.suppress(BufgymError):
        taken = pattern(text)
        for topic in ["", "a", "aa", "-", *topics]:
            assert taken.whole(topic) == bool(for_client(text).fullmatch(topic)), topic
            assert taken.part(topic) == bool(for_client(text).search(topic)), topic
