"""Frames byte by byte, and what is none."""

import json
from typing import Any

import pytest
import relay_cases  # noqa: F401  (skips where the extra is missing)
from hypothesis import given
from hypothesis import strategies as st

from bufgym.relay import wire
from bufgym.relay.wire import Message, WireError

names = st.text(st.characters(exclude_categories=("C", "Z")), max_size=60)
whole = st.integers(0, 2**53)
messages = st.builds(
    Message, names.map("/{}".format), st.binary(max_size=50), st.just("raw"), names, names, whole, whole, st.booleans()
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


@given(messages)
def test_what_is_written_is_read(message: Message) -> None:
    assert wire.decode(wire.encode(message)) == message
    assert wire.from_json(wire.heard(wire.to_json(message))) == message


def test_json_payloads_are_values() -> None:
    message = Message("/a", b'{"x": [1, null, "\\u00e4"]}')
    assert json.loads(wire.to_json(message))["data"] == {"x": [1, None, "ä"]}
    assert json.loads(bytes(wire.from_json(wire.heard(wire.to_json(message))).payload)) == {"x": [1, None, "ä"]}


GOOD = wire.encode(Message("/a", b"12"))
TWO = {2: "version 1", 3: "kind 1", 4: "a known flag"}
"""What a 2 at this place breaks."""


@pytest.mark.parametrize(
    ("read", "given", "error"),
    [
        (wire.decode, b"", "frame of 0 bytes"),
        (wire.decode, GOOD[:-1], "frame of 39 bytes: must be 40"),
        (wire.decode, GOOD + b"1", "frame of 41 bytes: must be 40"),
        *((wire.decode, data, "header") for data in (b"bX" + GOOD[2:], GOOD[:9] + b"\x01" + GOOD[10:])),
        *((wire.decode, GOOD[:k] + b"\x02" + GOOD[k + 1 :], says) for k, says in TWO.items()),
        (wire.decode, GOOD[:16] + b"\xff" * 8 + GOOD[24:], "seq"),
        (wire.decode, GOOD[:24] + b"\x7f" + GOOD[25:], "stamp_us"),
        (wire.decode, GOOD.replace(b"/a", b"aa"), "must begin with '/'"),
        (wire.decode, GOOD.replace(b"/a", b"/\n"), "must be printable"),
        (wire.decode, GOOD.replace(b"/a", b"/\xff"), "must be UTF-8"),
        *((wire.heard, text, "must be JSON") for text in ("", "[" * 10_000, "9" * 5_000)),
        (wire.heard, "3", "must be an object"),
        *((wire.heard, text, "must be an object whose op") for text in ('{"op": "dance"}', '{"op": ["hello"]}')),
        (wire.heard, '{"op": "hello"}', "missing required field `version`"),
        (wire.heard, '{"op": "hello", "version": true}', "Expected `int`, got `bool`"),
        (wire.heard, '{"op": "hello", "version": -1}', "Expected `int` >= 0"),
        (wire.heard, '{"op": "hello", "version": 1e99}', "Expected `int`, got `float`"),
        (wire.heard, '{"op": "publish", "topic": "/a", "data": NaN}', "NaN is no JSON"),
        (wire.heard, '{"op": "subscribe", "id": "a", "topic": 3}', r"Expected `str`, got `int` - at `\$.topic`"),
        (wire.heard, '{"op": "subscribe", "id": "a", "topic": "a", "priority": "1"}', "Expected `float`, got `str`"),
        (wire.from_json, {"topic": "a", "data": 1}, "must begin with '/'"),
        (wire.from_json, {"topic": "/\ud800", "data": 1}, "must be"),
        *((wire.from_json, {"topic": f"/{name}", "data": 1}, "at most 255 bytes") for name in ("a" * 255, "ä" * 128)),
        *((wire.from_json, {"topic": "/a", "encoding": "jpeg", "data": data}, "must be base64") for data in ("*", 3)),
        (wire.from_json, {"topic": "/a", "encoding": "", "data": ""}, "must not be empty"),
        (wire.heard, '{"op": "publish", "topic": "/a", "data": -1e400}', "the number -1e400 is no JSON"),
        *((wire.to_json, Message("/a", payload), "payload must be JSON") for payload in (b"{", b"1e400")),
    ],
)
def test_each_fault_is_named(read: Any, given: Any, error: str) -> None:
    with pytest.raises(WireError, match=error):
        read(given)
