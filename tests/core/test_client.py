"""A client of many topics: what it draws, its file, and every mistake in one line."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from refusal_cases import refused

from bufgym import scenario, traces
from bufgym.model import qoi
from bufgym.model.topics import Topic
from bufgym.scenario import Client, Stream, Streams, read_client
from bufgym.scenario.client import robofleet_example
from bufgym.utils.errors import BufgymError

LINK = traces.Trace.constant(1e6, 60.0, name="1 MB/s")
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "client.toml"
WORLD = {"traces": (LINK,), "motion": (traces.load_motion("drive-0"),)}


def client(*streams: Stream, **parameters: Any) -> Client:
    return Client(streams or (Stream(Topic("a"), 2, 100),), **{"traces": (LINK,), "duration_s": 2.0, **parameters})


def test_streams_are_merged_in_order_of_time() -> None:
    """Every 0.5 s an "a", every second a "b"; of one moment the first topic comes first."""
    two = client(
        Stream(Topic("a"), 2, 100, jitter=0), Stream(Topic("b"), 1, 7, jitter=0), random_offset=False, window=3
    )
    episode = two.draw(Streams.seeded(0))
    got = episode.arrivals
    assert got["arrival_us"].tolist() == [0, 0, 500_000, 1_000_000, 1_000_000, 1_500_000]
    assert got["topic"].tolist() == [0, 1, 0, 0, 1, 0]
    assert got["size_bytes"].tolist() == [100, 7, 100, 100, 7, 100]
    assert got["x"].tolist() == [0, 0, 1, 2, 1, 3]  # in periods of the own rate
    assert got["seq"].tolist() == list(range(6))
    assert (episode.window, episode.ack_delay_us, episode.link.propagation_us) == (3, 40_000, 20_000)
    assert client(propagation_us=7).ack_delay_us == 14
    assert client(propagation_us=7, round_trip_us=0).draw(Streams.seeded(0)).ack_delay_us == 0


def test_where_there_is_a_rate_limit_x_counts_its_periods() -> None:
    """Ten a second of which two may go: the fifth is one step on."""
    limited = Stream(Topic("a", rate_limit_hz=2), 10, 100, jitter=0)
    x = client(limited, random_offset=False).draw(Streams.seeded(0)).arrivals["x"]
    assert x == pytest.approx(np.arange(20) / 5)
    # A limit above the rate says nothing.
    idle = replace(limited, topic=Topic("a", rate_limit_hz=50))
    assert client(idle, random_offset=False).draw(Streams.seeded(0)).arrivals["x"] == pytest.approx(np.arange(20))


def test_x_of_a_stream_that_moves_is_the_robots_motion() -> None:
    moving = Stream(Topic("image"), 10, 100, jitter=0, moves=True)
    (motion,) = WORLD["motion"]
    episode = client(moving, motion=motion, random_offset=False).draw(Streams.seeded(0))
    expected = motion.at(episode.arrivals["arrival_us"])
    assert episode.arrivals["x"] == pytest.approx(expected - expected[0])
    # All that move see one motion at one time.
    both = client(moving, replace(moving, topic=Topic("cloud")), motion=motion).draw(Streams.seeded(4)).arrivals
    first, second = (both[both["topic"] == k] for k in (0, 1))
    steps = np.interp(second["arrival_us"], first["arrival_us"], first["x"])
    assert np.abs(np.diff(steps) - np.diff(both["x"][both["topic"] == 1])).max() < 0.05


@given(
    rates=st.lists(st.floats(0.5, 60), min_size=1, max_size=4),
    jitter=st.floats(0, 1),
    cv=st.sampled_from([0.0, 0.3, 2.0]),
    random_offset=st.booleans(),
    seed=st.integers(0, 2**32),
)
def test_draws_are_well_formed(rates: list[float], jitter: float, cv: float, random_offset: bool, seed: int) -> None:
    streams = [Stream(Topic(f"t{k}"), hz, 500, jitter=jitter, size_cv=cv) for k, hz in enumerate(rates)]
    drawing = client(*streams, random_offset=random_offset, duration_s=3.0)
    got = drawing.draw(Streams.seeded(seed)).arrivals
    assert len(got) == drawing.max_messages == sum(max(1, round(hz * 3)) for hz in rates)
    assert got["arrival_us"][0] == 0 and (np.diff(got["arrival_us"]) >= 0).all()
    assert (got["seq"] == np.arange(len(got))).all() and got["size_bytes"].min() >= 1
    for k, hz in enumerate(rates):
        own = got[got["topic"] == k]
        assert len(own) == max(1, round(hz * 3))
        assert own["x"][0] == 0 and (np.diff(own["x"]) >= 0).all()
    again = drawing.draw(Streams.seeded(seed))
    faster = client(scale=2.0, random_offset=random_offset).draw(Streams.seeded(seed))
    assert again.arrivals.tobytes() == got.tobytes()
    assert again.link.offset_us == faster.link.offset_us  # links and arrivals have chances of their own


def test_other_encodings_keep_each_messages_share() -> None:
    """JSON of 300 bytes for 100: three times as much for each message; what is not given stays the same."""
    streams = (Stream(Topic("a"), 5, 100, size_cv=0.5, encodings={"json": 300}), Stream(Topic("b"), 5, 50))
    episode = client(*streams).draw(Streams.seeded(2))
    sizes, topic = episode.arrivals["size_bytes"], episode.arrivals["topic"]
    assert (episode.encodings["json"] == np.where(topic == 0, 3 * sizes, sizes)).all()
    assert (episode.encodings["ros"] == sizes).all()
    assert (episode.encoded("json").arrivals["size_bytes"] == episode.encodings["json"]).all()
    # Never less than a byte.
    tiny = client(Stream(Topic("a"), 5, 1000, encodings={"ros": 1}, size_cv=2.0)).draw(Streams.seeded(2))
    assert tiny.encodings["ros"].min() == 1


def test_the_example_file_is_robofleets_example() -> None:
    read = read_client(EXAMPLE, **WORLD)
    assert read.streams == robofleet_example()
    for ours, theirs in zip(read.topics, robofleet_example(), strict=True):
        # Values compare by name; to the last bit they are the same too.
        assert ours.value is not None and theirs.topic.value is not None
        assert ours.value.array.tolist() == theirs.topic.value.array.tolist()
    named = scenario.get("topics")
    assert isinstance(named, Client) and named.streams == robofleet_example() and named.scale == 0.25
    default = Client(robofleet_example(), **WORLD)
    for name in ("window", "propagation_us", "ack_delay_us", "consumers", "duration_s", "value", "scale"):
        assert getattr(read, name) == getattr(default, name), name


A = '[[topic]]\nname = "a"\nrate_hz = 2\nsize_bytes = 100\n'
"""The least that a file can hold. (All rules for a topic: test_schedulers.py.)"""


def read(tmp_path: Path, text: str | bytes | None, **parameters: Any) -> Client:
    path = tmp_path / "client.toml"
    if text is not None:
        path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_client(path, **{"traces": (LINK,), **parameters})


def test_the_least_file(tmp_path: Path) -> None:
    assert read(tmp_path, A) == Client((Stream(Topic("a"), 2, 100),), (LINK,))
    without = read_client(EXAMPLE)  # it meets what is shipped
    assert without.traces == tuple(traces.load(f"lte-synthetic-{k}") for k in range(8))
    assert [motion.name for motion in without.motion] == ["drive-0", "drive-1"]


def test_a_file_may_say_all_that_a_topic_takes(tmp_path: Path) -> None:
    rest = 'priority = 3\nrate_limit_hz = 1.5\nlimit = 4\nweight = 0\ndeadline_s = 0.2\nvalue = "saturating:4"\n'
    rest += "jitter = 0.5\nsize_cv = 0.25\nmoves = true\nencodings = { ros = 50 }\n"
    made = read(tmp_path, f"window = 5\nround_trip_us = 9\nconsumers = 2\nduration_s = 3\n{A}{rest}", **WORLD)
    topic = Topic("a", 3, 1.5, limit=4, weight=0, deadline_s=0.2, value=qoi.saturating(4))
    assert made.streams == (Stream(topic, 2, 100, jitter=0.5, size_cv=0.25, moves=True, encodings={"ros": 50}),)
    assert (made.window, made.ack_delay_us, made.consumers, made.duration_s) == (5, 9, 2, 3)


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        (A + "priority = -1\n", "topic 'a': priority = -1: must be a number >= 0"),
        (A.replace("rate_hz = 2", "rate_hz = 0"), "topic 'a': rate_hz = 0: must be a number > 0"),
        (A.replace("rate_hz = 2", ""), "topic 'a': rate_hz is missing"),
        (A.replace('name = "a"', ""), "name is missing"),
        (A.replace('"a"', "3"), "topic 3: a name must be a non-empty text"),
        (A.replace("100", "1.5"), "topic 'a': size_bytes = 1.5: must be a whole number"),
        (A + "encodings = { xml = 3 }\n", "topic 'a': unknown encoding 'xml'; known: ros, json"),
        (A + "encodings = 3\n", "topic 'a': encodings = 3: must be a table"),
        (A + "moves = true\n", "topic 'a': moves, but the client has no motion recording"),
        (A + A, "topic 'a': two topics have this name"),
        (A.replace("[[topic]]", "[[topics]]"), "unknown key 'topics'; did you mean 'topic'"),
        ("consumers = 0\n" + A, "consumers = 0: must be a whole number >= 1"),
        ("round_trip_us = -1\n" + A, "round_trip_us = -1: must be a whole number from 0 to"),
        ('duration_s = "x"\n' + A, "duration_s = 'x': must be a number > 0"),
        ("duration_s = 1e7\n" + A, "20000000 messages in all: must lie between 1 and 10000000"),
        ("", r"needs at least one \[\[topic\]\]"),
        ("topic = [3]", r"topic = 3: must be a \[\[topic\]\] table"),
        ("window = \n", "line 1"),
        (b"\xff\xfe", "must be UTF-8 text"),
        (None, "no such file"),
    ],
)
def test_bad_files_are_one_line_that_names_the_file(tmp_path: Path, text: Any, rule: str) -> None:
    with pytest.raises(BufgymError, match=f"client.toml: .*{rule}") as caught:
        read(tmp_path, text)
    assert "\n" not in str(caught.value)


test_bad_clients = refused(
    (lambda: Stream("a", 1, 1), r"stream: 'a' is not a bufgym\.model\.topics\.Topic"),
    (lambda: replace(client(), streams=()), "streams: a client needs at least one"),
    (lambda: replace(client(), streams=(Topic("a"),)), "is not a bufgym.scenario.Stream"),
    (lambda: replace(client(), traces=()), "traces: a client needs at least one"),
    (
        lambda: replace(client(), consumers=2_500_001),
        "10000004 messages in all, with a copy for each of 2500001 consumers: must lie",
    ),
    (lambda: replace(client(), traces="lte"), "lte: no such file, and no shipped trace"),
    (lambda: replace(client(), motion=(3,)), "motion: 3 is not a bufgym.traces Motion"),
    (lambda: replace(client(), scale=0), "scale = 0: must be a number > 0"),
    (lambda: replace(client(), duration_s=math.nan), "duration_s = nan: must be a number > 0"),
    (lambda: replace(client(), value="exponential:wide"), "exponential:wide"),
)
