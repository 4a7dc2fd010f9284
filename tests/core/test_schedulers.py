"""Schedulers and Robofleet's rivals: their clients, and settings that are refused. (All else: test_topics_reference)"""

import naive_schedulers
import numpy as np
import pytest
from cases import order, trace
from refusal_cases import refused

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.checks import check_window
from bufgym.model.link import Link
from bufgym.model.topics import Topic, check_topics
from bufgym.scenario import Episode, messages
from bufgym.sim import Senders, run

pytestmark = pytest.mark.kernels
V = qoi.exponential(0.618)
MS = 1_000
NAMES = list(naive_schedulers.REFERENCES)
ALL = [name for name in policies.names() if policies.get(name).privileged is None]


def played(name, script, topics, *, capacity=8):
    """``script``: "0 A, 10 B" and so on, ms and topic; 1000 bytes each.

    Nothing crosses for 100 ms, then 1000 bytes a ms. So message 0, which the socket takes at once, leaves at 101 ms,
    and one a ms after it.
    """
    lines = [line.split() for line in script.split(",")]
    arrivals = messages(np.array([int(float(ms) * MS) for ms, _ in lines]), 1_000)
    arrivals["topic"] = ["ABCN".index(topic) for _, topic in lines]
    link = Link(trace([(0, 0), (100 * MS, 0), (1_100 * MS, 1_000 * 1_000)], "hold"))
    return run(policies.get(name), [Episode(arrivals, link)], capacity, V, topics=topics)


def topics(a=1.0, b=2.0, c=3.0, **more):
    """A, B, C with these priorities (or settings), and N, which may not be dropped."""
    rules = [given if isinstance(given, dict) else {"priority": given} for given in (a, b, c)]
    return [*(Topic(name, **given) for name, given in zip("ABC", rules, strict=True)), Topic("N", no_drop=True, **more)]


def test_clients():
    def client(name):
        return policies.get(name).client

    assert [name for name in ALL if client(name).limit_at_send or client(name).flush_no_drop] == ["robofleet-released"]
    assert [name for name in ALL if not client(name).awaits_acks] == ["ros-native", "rosbridge"]
    assert {n: client(n).encoding for n in ALL if client(n).encoding} == {"rosbridge": "json", "ros-native": "ros"}
    assert [name for name in ALL if client(name).copies] == ["ros-native"]


def test_made_for_topics():
    assert sorted(policies.names(for_topics=True)) == sorted([*NAMES, "gap-priority"])
    assert sorted([*policies.names(for_topics=True), *policies.names(for_topics=False)]) == sorted(policies.names())


def test_your_own_can_be_made_for_topics():
    def last_in(buffer, memory):
        """The oldest of the topic whose message came last."""
        newest = buffer.slots[len(buffer.slots) - 1].topic
        return next(k for k, slot in enumerate(buffer.slots) if slot.topic == newest)

    policies.register("lifo", on_send=last_in, for_topics=True)(policies.get("fifo").on_arrival)
    assert "lifo" in policies.names(for_topics=True) and "lifo" not in policies.names(for_topics=False)
    assert policies.get("lifo").schedules and not policies.get("drop-oldest").schedules
    assert order(played("lifo", "0 A, 1 B, 2 A, 3 B", topics())) == [0, 1, 3, 2]


def episode(times_ms, topic=0, **more):
    """Messages of 1000 bytes over a link of 1 MB/s."""
    arrivals = messages(np.array(times_ms) * MS, 1_000)
    arrivals["topic"] = topic
    return Episode(arrivals, Link(trace([(0, 0), (1_000 * MS, 1_000_000)], "loop")), **more)


def after_run(played, topics=()):
    return run(policies.get("drop-newest"), [played], 5, V, topics=topics)


A_B = (Topic("a"), Topic("b"))


test_what_is_refused = refused(
    (lambda: Topic(""), "topic '': a name must be a non-empty text"),
    *((lambda p=p: Topic("a", priority=p), "must be a number >= 0") for p in (-1, None, True, np.inf, 10**400)),
    *((lambda hz=hz: Topic("a", rate_limit_hz=hz), "must be a number > 0") for hz in (0, "10")),
    (lambda: Topic("a", weight=float("nan")), "weight = nan: must be a number >= 0"),
    *((lambda s=s: Topic("a", deadline_s=s), r"deadline_s = .*: must be a number > 0") for s in (0, 1e300)),
    (lambda: Topic("a", no_drop=1), "no_drop = 1: must be true or false"),
    *((lambda n=n: Topic("a", limit=n), "must be a whole number from 1") for n in (0, 1.5)),
    (lambda: Topic("a", value=0.618), "value = 0.618: must be a V of bufgym.model.qoi"),
    (lambda: Topic("a", no_drop=True, limit=3), "limit = 3: a no_drop topic can't have a limit"),
    (lambda: Senders(1, 2, V, max_messages=1, topics=[*A_B, Topic("a")]), "topic 'a': two topics have this name"),
    (lambda: check_topics(["a"]), "'a' is not a bufgym"),
    (lambda: check_topics([Topic(str(k)) for k in range(257)]), "257 topics: must be at most 256"),
    (lambda: after_run(episode([0, 1], [0, 2]), A_B), "episode: unknown topic 2; the senders know 2, from 0 on"),
    (lambda: after_run(episode([0, 1], [0, -1]), A_B), "message 1: topic = -1: must be >= 0"),
    *((lambda n=n: check_window(n), "n_T must be a whole number from 1") for n in (0, 1.0, True, "2", 10**6 + 1)),
    (lambda: after_run(episode([0], window=0)), "n_T must be a whole number from 1"),
    *((lambda us=us: episode([0], ack_delay_us=us), "must be a whole number from 0 to") for us in (-1, 0.5, None)),
)


def test_the_slowest_rate_limit():
    # Slower than any episode is long: the first message and no other.
    assert order(after_run(episode([0, 1, 10**9]), (Topic("a", rate_limit_hz=1e-300),))) == [0]
