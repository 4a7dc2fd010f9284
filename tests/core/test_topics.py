"""The sender with topics, worked by hand; settings of topics and of the in-flight window that are refused."""

import numpy as np
import pytest
from cases import log, order, trace, watched
from refusal_cases import refused

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.buffer import ACCEPT, HOLD, REJECT
from bufgym.model.checks import check_window
from bufgym.model.link import FOREVER, Link
from bufgym.model.topics import Topic, check_topics
from bufgym.policies.registry import ClientSettings
from bufgym.scenario import Episode, messages
from bufgym.sim import Senders, run
from bufgym.sim.rules import age_until

pytestmark = pytest.mark.kernels
V = qoi.exponential(0.5)
MS = 1_000


def episode(times_ms, topic=0, *, x=None, sizes=1_000, knots=((0, 0), (1_000 * MS, 1_000_000)), after="loop", **more):
    """Messages of 1000 bytes over a link of 1 MB/s: each takes 1 ms."""
    arrivals = messages(np.round(np.array(times_ms) * MS).astype(np.int64), np.asarray(sizes, np.int64), x)
    arrivals["topic"] = topic
    propagation_us = more.pop("propagation_us", 0)
    return Episode(arrivals, Link(trace(list(knots), after), propagation_us=propagation_us), **more)


def take_all(buffer, arrival, memory):
    """Accepts what fits, rejects the rest."""
    return ACCEPT if len(buffer.slots) < buffer.capacity else REJECT


def scripted(*answers):
    """A scheduler that gives these answers in turn."""
    left = list(answers)
    return lambda buffer, memory: left.pop(0)


def after_run(played, topics=(), *, capacity=5, on_arrival=take_all, client=None, **hooks):
    policy = policies.Policy("by-hand", on_arrival, client=client or ClientSettings(), **hooks)
    return run(policy, [played], capacity, V, topics=topics)


@pytest.mark.parametrize(
    ("messages_at_0", "settings", "client", "dequeued_ms", "transmitted_ms"),
    [
        # 0 and 1 go at once: 0 crosses at 1 ms, 1 behind it at 2. Their acks come at 101 and 102 ms and let 2 and 3 go;
        # 3 follows 2 on the link (102 to 103 ms). The ack of 2 comes at 202 ms and lets 4 go.
        (5, {"window": 2, "ack_delay_us": 100 * MS}, {}, [0, 0, 101, 102, 202], [1, 2, 102, 103, 203]),
        # Each message takes 1 ms and its ack another 50: one every 51 ms, on a link that could carry 51 meanwhile.
        (3, {"window": 1, "ack_delay_us": 50 * MS}, {}, [0, 51, 102], [1, 52, 103]),
        # Without acks to wait for, the window only counts what has not crossed yet.
        (3, {"window": 3}, {}, [0, 0, 0], [1, 2, 3]),
        # A client that awaits no acks.
        (3, {"window": 2, "ack_delay_us": 50 * MS}, {"awaits_acks": False}, [0, 1, 2], [1, 2, 3]),
        # Flushing is for no_drop topics: a plain sender has none, and its window holds.
        (3, {"window": 1, "ack_delay_us": 50 * MS}, {"flush_no_drop": True}, [0, 51, 102], [1, 52, 103]),
    ],
)
def test_windows_of_messages_in_flight(messages_at_0, settings, client, dequeued_ms, transmitted_ms):
    senders = after_run(episode([0] * messages_at_0, **settings), client=ClientSettings(**client))
    assert log(senders)["dequeued_us"] == {k: ms * MS for k, ms in enumerate(dequeued_ms)}
    assert log(senders)["transmitted_us"] == {k: ms * MS for k, ms in enumerate(transmitted_ms)}


@pytest.mark.parametrize(("third_ms", "dropped"), [(51, {}), (50.999, {2: 50_999})])
def test_a_pong_comes_before_an_arrival_at_its_instant(third_ms, dropped):
    # L = 1: message 1 waits for the pong of 0, at 51 ms. What comes then finds room, a microsecond earlier it does not.
    senders = after_run(episode([0, 0, third_ms], window=1, ack_delay_us=50 * MS), capacity=1)
    assert log(senders)["dropped_us"] == dropped


def test_10_hz_of_a_30_hz_stream_is_every_third():
    camera = (Topic("camera", rate_limit_hz=10),)
    policy, asked = watched(lambda buffer, arrival: int(arrival.seq))
    # 0, 33.333, 66.667, 100, ... ms: those kept are exactly 1 / rate apart. Of the others nobody is asked.
    senders = after_run(episode([round(k * 1e6 / 30) / MS for k in range(10)]), camera, on_arrival=policy.on_arrival)
    assert order(senders) == asked == [0, 3, 6, 9]
    assert log(senders)["dropped_us"].keys() == {1, 2, 4, 5, 7, 8}
    assert np.asarray(senders.batch.log[0])["limited"].tolist() == [0, 1, 1] * 3 + [0]
    # A microsecond too soon after the last one kept is too soon; what was dropped does not count.
    senders = after_run(episode([0, 99.999, 100, 199.999, 200.001]), camera)
    assert order(senders) == [0, 2, 4]
    # What the policy rejected was not kept either: 1 comes 1 ms later and is asked about.
    senders = after_run(episode([0, 1, 2]), camera, on_arrival=lambda b, a, m: REJECT if a.seq == 0 else ACCEPT)
    assert log(senders)["dropped_us"] == {0: 0, 2: 2 * MS}


def test_holding_until_the_next_arrival_or_pong():
    # 0 is held back at 0 ms; at 5 ms message 1 arrives, both wait, the scheduler holds again; nothing else is to come
    # after 7 ms, so that the third HOLD is impossible and 0 goes. At its crossing 1 goes, then 2.
    senders = after_run(episode([0, 5, 7]), on_send=scripted(HOLD, HOLD, HOLD, 0, 0))
    assert log(senders)["dequeued_us"] == {0: 7 * MS, 1: 8 * MS, 2: 9 * MS}
    assert senders.batch.senders[0]["invalid"] == 1
    # While a pong is to come, holding is possible: 1 is held back at 1 ms of its own accord until that of 0 at 11 ms.
    senders = after_run(episode([0, 0], window=2, ack_delay_us=10 * MS), on_send=scripted(0, HOLD, 0))
    assert log(senders)["dequeued_us"] == {0: 0, 1: 11 * MS}


def test_age_of_information_and_lateness():
    # Messages of a come at 0 and 4 ms, cross at 1 and 5 ms, are received at 3 and 7 ms. From 0 to 7 ms the age grows
    # from 0 to 7 ms (the first is 3 ms old when it is received): 24.5 ms^2. Then it is 3 ms; the last arrival, b's at
    # 10 ms, finds it at 6: 13.5 ms^2. Twice that, for weight 2. Both took 3 ms: not later than 3 ms.
    played = episode([0, 4, 10], [0, 0, 1], propagation_us=2 * MS)
    senders = after_run(played, (Topic("a", weight=2, deadline_s=0.003), Topic("b"), Topic("c")))
    assert senders.batch.senders[0]["aged"] == pytest.approx(2 * 24.5e-6, rel=1e-12)
    assert senders.batch.senders[0]["late"] == 0
    for until_us in (9 * MS, 10 * MS, 10 * MS, FOREVER):  # what has been counted is not counted again
        for topic in range(3):  # b's age begins at 10 ms, where all ends; nothing has come of c
            age_until(senders.batch, 0, topic, until_us)
    assert senders.batch.senders[0]["aged"] == pytest.approx(2 * 38e-6, rel=1e-12)
    assert senders.batch.topics[0, 0]["aged"] == pytest.approx(38e-6, rel=1e-12)
    senders = after_run(played, (Topic("a", weight=2, deadline_s=0.002999), Topic("b")))
    assert senders.batch.senders[0]["late"] == 4


def test_a_rate_limit_comes_before_no_drop():
    # 10 Hz: 1 comes too soon and is dropped, though there is room and its topic is no_drop; nobody is asked.
    command = (Topic("command", no_drop=True, rate_limit_hz=10), Topic("camera"))
    policy, asked = watched(lambda buffer, arrival: int(arrival.seq))
    senders = after_run(episode([0, 50, 100]), command, on_arrival=policy.on_arrival)
    assert order(senders) == asked == [0, 2]
    log_row, sender = np.asarray(senders.batch.log[0]), senders.batch.senders[0]
    assert log_row["limited"].tolist() == [0, 1, 0] and (sender["rejected"], sender["invalid"]) == (1, 0)
    # What passed it is kept, whatever the policy says.
    senders = after_run(episode([0, 50, 100]), command, on_arrival=lambda b, a, m: REJECT)
    assert order(senders) == [0, 2]
    # Where limits hold back at the socket, no_drop topics have none: Robofleet's released client.
    senders = after_run(episode([0, 50, 100]), command, client=ClientSettings(limit_at_send=True))
    assert log(senders)["dequeued_us"] == {0: 0, 1: 50 * MS, 2: 100 * MS}


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
