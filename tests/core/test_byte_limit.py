"""A byte limit B: an eviction that does not make room enough is carried out, and the policy is asked again."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from cases import log, order, same, trace

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.model.topics import Topic
from bufgym.policies import ACCEPT, REJECT, Policy
from bufgym.scenario import Episode, messages
from bufgym.sim import run
from bufgym.sim.metrics import outcome

kernels = pytest.mark.kernels
V = qoi.exponential(0.5)
SLOW = Link(trace([(0, 0), (1_000_000, 100), (2_000_000, 10_000_000)], "hold"))
"""What arrives in its first second waits: message 0 alone is in the socket."""


def blocked(sizes, limit, topic=None, **episode):
    """(the episode in which these come at once while the link stands, its limits)."""
    arrivals = messages(np.zeros(len(sizes), np.int64), np.array(sizes))
    arrivals["topic"] = 0 if topic is None else topic
    return Episode(arrivals, SLOW, **episode), {"capacity": 8, "v": V, "max_bytes": limit}


def played(name, sizes, limit, **more):
    policy = policies.get(name) if isinstance(name, str) else name
    episode, limits = blocked(sizes, limit)
    return run(policy, [episode], **limits, **more)


@kernels
def test_evicts_until_the_newcomer_fits():
    # B = 2500. Message 0 is in transmission; 1, 2, 3 (1000, 1000, 500) are queued. 4 (2000) needs both of the oldest.
    sizes = [100, 1_000, 1_000, 500, 2_000]
    senders = played("drop-oldest", sizes, 2_500)
    assert log(senders)["dropped_us"] == {1: 0, 2: 0}
    assert order(senders) == [0, 3, 4]
    assert outcome(senders, 0).invalid == 0
    # The tail first: 3, then 2; beside 1 (1000) there is still no room.
    assert order(played("replace-newest", sizes, 2_500)) == [0, 4]
    assert order(played("drop-newest", sizes, 2_500)) == [0, 1, 2, 3]


@kernels
def test_asks_again_about_the_same_arrival():
    asked = []

    def on_arrival(buffer, arrival, memory):
        asked.append((int(arrival.seq), buffer.slots.seq.tolist(), buffer.evictions))
        if buffer.backlog_bytes + arrival.size_bytes <= buffer.max_bytes:
            return ACCEPT
        return REJECT if arrival.seq == 5 and buffer.evictions == 1 else 0

    senders = played(Policy("test-asked", on_arrival), [100, 1_000, 1_000, 500, 2_000, 2_400, 2_501], 2_500)
    assert asked == [
        (0, [], 0),
        (1, [], 0),
        (2, [1], 0),
        (3, [1, 2], 0),
        (4, [1, 2, 3], 0),
        (4, [2, 3], 1),
        (5, [3, 4], 0),
        (5, [4], 1),  # and rejects: what it evicted is gone all the same
    ]  # 6 is larger than B and is dropped unasked
    told = outcome(senders, 0)
    assert log(senders)["dropped_us"].keys() == {1, 2, 3, 5, 6}
    assert (told.invalid, told.dropped, told.delivered) == (0, 5, 2)


@kernels
def test_a_no_drop_message_drives_out_as_many_as_it_needs():
    # A policy that rejects them: the least important goes, oldest first, until the no_drop message 4 fits. 5 could not
    # fit whatever went, as 4 stays: nothing goes for it.
    topics = [Topic("low", priority=1), Topic("high", priority=2), Topic("kept", no_drop=True)]
    reject = Policy("test-reject", lambda buffer, arrival, memory: REJECT if arrival.topic == 2 else ACCEPT)
    episode, limits = blocked([100, 400, 400, 200, 700, 400], 1_000, topic=[0, 1, 0, 0, 2, 2])
    for first in (0, 100):  # asked, or not
        senders = run(reject, [replace(episode, first_decision=first)], **limits, topics=topics)
        assert log(senders)["dropped_us"].keys() == {1, 2, 3, 5}
        assert order(senders) == [0, 4]


RANKED = [
    policy for policy in map(policies.get, policies.names(for_topics=False)) if policy.ranked and not policy.weights
]


# steady has as many sites as L says.
@pytest.mark.parametrize("policy", [p for p in RANKED if p.name != "steady"], ids=lambda p: p.name)
def test_with_equal_sizes_it_is_a_limit_of_messages(policy):
    rng = np.random.default_rng(5)
    arrivals = messages(np.arange(300) * 33_333, 1_000, np.cumsum(rng.random(300) ** 4))
    knots = [(0, 0), (1_000_000, 20_000), (4_000_000, 20_000), (6_000_000, 90_000), (10_000_000, 190_000)]
    episode = Episode(arrivals, Link(trace(knots, "hold"))).with_uniforms(rng)
    for k in (1, 4):
        by_bytes = run(policy, [episode], 8, V, max_bytes=k * 1_000)
        assert outcome(by_bytes, 0).invalid == 0
        assert same(by_bytes, run(policy, [episode], k, V))


def test_each_victim_is_a_draw_of_its_own():
    # Random Drop, five queued, 1000 bytes each; the newcomer needs two of them to go. Rejected at once: 1/6. Else one
    # of five goes; then itself with 1/5: 5/6 x 1/5 = 1/6. Else two of the five: 2/3.
    n, rng = 3_000, np.random.default_rng(0)
    episode, limits = blocked([100, 1_000, 1_000, 1_000, 1_000, 1_000, 2_000], 5_000)
    senders = run(policies.get("random"), [episode.with_uniforms(rng) for _ in range(n)], **limits)
    gone = Counter(tuple(sorted(log(senders, i)["dropped_us"])) for i in range(n))
    assert gone[(6,)] / n == pytest.approx(1 / 6, abs=0.03)
    single = [count / n for pair, count in gone.items() if len(pair) == 2 and 6 in pair]
    double = [count / n for pair, count in gone.items() if len(pair) == 2 and 6 not in pair]
    assert single == pytest.approx([1 / 30] * 5, abs=0.015)
    assert double == pytest.approx([1 / 15] * 10, abs=0.02)
