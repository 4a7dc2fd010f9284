"""Settings of topics and of the in-flight window that are refused."""

from __future__ import annotations

import pytest
from cases import order
from test_topics import V, after_run, episode

from bufgym.errors import BufgymError
from bufgym.model.checks import check_window
from bufgym.model.topics import Topic, check_topics
from bufgym.sim import Senders


@pytest.mark.parametrize(
    ("given_", "complaint"),
    [
        ({"name": ""}, "topic '': a name must be a non-empty text"),
        ({"priority": -1}, "topic 'a': priority = -1: must be a number >= 0"),
        ({"priority": None}, "priority = None: must be a number >= 0"),
        ({"priority": True}, "priority = True: must be a number >= 0"),
        ({"priority": float("inf")}, "priority = inf: must be a number >= 0"),
        ({"priority": 10**400}, "must be a number >= 0"),
        ({"rate_limit_hz": 0}, "rate_limit_hz = 0: must be a number > 0"),
        ({"rate_limit_hz": "10"}, "rate_limit_hz = '10': must be a number > 0"),
        ({"weight": float("nan")}, "weight = nan: must be a number >= 0"),
        ({"weight": -0.5}, "weight = -0.5: must be a number >= 0"),
        ({"deadline_s": 0}, "deadline_s = 0: must be a number > 0"),
        ({"deadline_s": 1e300}, "deadline_s = 1e\\+300: must be a number > 0"),
        ({"no_drop": 1}, "no_drop = 1: must be true or false"),
        ({"limit": 0}, "limit = 0: must be a whole number from 1"),
        ({"limit": 1.5}, "limit = 1.5: must be a whole number from 1"),
        ({"value": 0.618}, "value = 0.618: must be a V of bufgym.model.qoi"),
        ({"no_drop": True, "limit": 3}, "limit = 3: a no_drop topic can't have a limit"),
    ],
)
def test_bad_topic(given_, complaint):
    with pytest.raises(BufgymError, match=complaint) as caught:
        Topic(**{"name": "a", **given_})
    assert "\n" not in str(caught.value)


def test_bad_lists_of_topics():
    with pytest.raises(BufgymError, match="topic 'a': two topics have this name"):
        Senders(1, 2, V, max_messages=1, topics=[Topic("a"), Topic("b"), Topic("a")])
    with pytest.raises(BufgymError, match="'a' is not a bufgym"):
        check_topics(["a"])
    with pytest.raises(BufgymError, match="257 topics: must be at most 256"):
        check_topics([Topic(str(k)) for k in range(257)])


@pytest.mark.parametrize(
    ("topic", "complaint"),
    [
        ([0, 2], "episode: unknown topic 2; the senders know 2, from 0 on"),
        ([0, -1], "message 1: topic = -1: must be >= 0"),
    ],
)
def test_an_episode_with_an_unknown_topic(topic, complaint):
    with pytest.raises(BufgymError, match=complaint):
        after_run(episode([0, 1], topic), (Topic("a"), Topic("b")))


def test_the_slowest_rate_limit():
    # Slower than any episode is long: the first message and no other.
    assert order(after_run(episode([0, 1, 10**9]), (Topic("a", rate_limit_hz=1e-300),))) == [0]


@pytest.mark.parametrize("window", [0, -1, 1.0, True, "2", None, 10**6 + 1])
def test_bad_window(window):
    with pytest.raises(BufgymError, match="n_T must be a whole number from 1"):
        check_window(window)
    with pytest.raises(BufgymError, match="n_T must be a whole number from 1"):
        after_run(episode([0], window=window))


@pytest.mark.parametrize("ack_delay_us", [-1, 0.5, True, None, 2**62])
def test_bad_pong(ack_delay_us):
    with pytest.raises(BufgymError, match=f"ack_delay_us = {ack_delay_us!r}: must be a whole number from 0 to"):
        after_run(episode([0], ack_delay_us=ack_delay_us))
