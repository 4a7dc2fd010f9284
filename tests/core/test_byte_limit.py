"""A byte limit B: an eviction that does not make room enough is carried out, and the policy is asked again."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from cases import cases, log, order, same, trace
from hypothesis import given, settings
from hypothesis import strategies as st

from bufgym import policies
from bufgym.benchmark.run import draw
from bufgym.kernel import JIT
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.model.topics import Topic
from bufgym.policies import ACCEPT, REJECT, Policy
from bufgym.scenario import Episode, FleetEpisode, messages, registry
from bufgym.sim import run
from bufgym.sim.cell import run_fleet
from bufgym.sim.metrics import outcome

V = qoi.exponential(0.5)
SLOW = Link(trace([(0, 0), (1_000_000, 100), (2_000_000, 10_000_000)], "hold"))
"""What arrives in its first second waits: message 0 alone is in the socket."""

RANKED = [policies.get(name) for name in policies.names(for_topics=False)]
RANKED = [policy for policy in RANKED if policy.ranked and not policy.weights]
"""The fixed policies of one queue."""


def blocked(sizes, limit, topic=None, **episode):
    """(the episode in which these come at once while the link stands, its limits)."""
    arrivals = messages(np.zeros(len(sizes), np.int64), np.array(sizes))
    arrivals["topic"] = 0 if topic is None else topic
    return Episode(arrivals, SLOW, **episode), {"capacity": 8, "v": V, "max_bytes": limit}


def played(name, sizes, limit, **more):
    policy = policies.get(name) if isinstance(name, str) else name
    episode, limits = blocked(sizes, limit)
    return run(policy, [episode], **limits, **more)


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


def test_what_is_not_asked_makes_no_room():
    senders = run(
        policies.get("drop-oldest"), [blocked([100, 600, 600], 1_000, last_decision=1)[0]], 8, V, max_bytes=1_000
    )
    assert order(senders) == [0, 1]


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


def test_policies_count_an_arrival_once():
    # Decimate keeps 0, 2, 4, 6, 8. Message 6 (1000) needs both 2 and 4 (400) to go, and 8 then 6 alone.
    sizes = [100, 10, 400, 10, 400, 10, 1_000, 10, 1_000]
    assert order(played("decimate:every=2", sizes, 1_200)) == [0, 8]
    reservoir = policies.get("reservoir")
    memory = reservoir.new_memory()
    played(replace(reservoir, on_departure=policies.get("random").on_departure), sizes, 1_200, memory=memory)
    assert memory[0] == len(sizes)


def test_afr_goes_on_with_its_pass():
    # B = 1200: 1 .. 4 (300 each) fill it. 5 (600) takes 1, then 3, as two newcomers of 300 would; p = 2, where three
    # messages are queued. 6 (300) takes the one at 2, message 5, and the pass is done: r = 2.
    afr = policies.get("afr-paper")
    for sizes, left, remembered in (
        ([100, 300, 300, 300, 300, 600], [0, 2, 4, 5], (1, 0, 2)),
        ([100, 300, 300, 300, 300, 600, 300], [0, 2, 4, 6], (2, 0, 0)),
    ):
        memory = afr.new_memory()
        assert order(played(afr, sizes, 1_200, memory=memory)) == left
        assert tuple(memory[0]) == remembered


@pytest.mark.parametrize("policy", [p for p in RANKED if p.name != "steady"], ids=lambda p: p.name)
def test_with_equal_sizes_it_is_a_limit_of_messages(policy):
    # steady has as many sites as L says.
    rng = np.random.default_rng(5)
    arrivals = messages(np.arange(300) * 33_333, 1_000, np.cumsum(rng.random(300) ** 4))
    knots = [(0, 0), (1_000_000, 20_000), (4_000_000, 20_000), (6_000_000, 90_000), (10_000_000, 190_000)]
    episode = Episode(arrivals, Link(trace(knots, "hold"))).with_uniforms(rng)
    for k in (1, 4):
        by_bytes = run(policy, [episode], 8, V, max_bytes=k * 1_000)
        assert outcome(by_bytes, 0).invalid == 0
        assert same(by_bytes, run(policy, [episode], k, V))


def test_fixed_policies_no_longer_do_the_same():
    episodes = [draw(registry.get("lte", size_bytes=230_000, size_cv=0.5), seed) for seed in range(3)]
    names = ("drop-oldest", "drop-newest", "replace-newest", "random", "reservoir", "min-gap", "min-motion-gap", "afr")
    rows = {
        name: run(policies.get(name), episodes, 32, V, max_bytes=2_500_000) for name in (*names, "orbbuf", "steady")
    }
    h = {name: round(sum(outcome(senders, i).qoi for i in range(3)), 6) for name, senders in rows.items()}
    assert len(set(h.values())) == len(h), h
    for senders in rows.values():
        assert all(outcome(senders, i).invalid == 0 for i in range(3))


@given(cases(), st.sampled_from([policies.get(name) for name in policies.names() if not policies.get(name).privileged]))
@settings(max_examples=200 if JIT else 20)
def test_every_decision_is_possible_and_nothing_is_lost(case, policy):
    case = replace(case, decide_at="arrival", episode=replace(case.episode, first_decision=0, last_decision=2**31))
    senders = run(policy, [case.episode], case.capacity, V, max_bytes=case.max_bytes)
    told, limit = outcome(senders, 0), case.max_bytes or np.inf
    assert told.invalid == 0
    assert told.arrived == told.delivered + told.in_transmission + told.buffered + told.dropped
    assert policy.unbounded or senders.batch.senders[0]["peak_backlog_bytes"] <= limit


def test_an_unbounded_queue_has_no_byte_limit():
    assert order(played("rosbridge", [100, 600, 600, 600], 1_000)) == [0, 1, 2, 3]


def test_a_robot_of_a_cell_is_asked_again():
    # Two robots on one link: the first as in the first test, the second with messages that fit.
    arrivals = [
        messages(np.zeros(5, np.int64), np.array(sizes)) for sizes in ([100, 1_000, 1_000, 500, 2_000], [100] * 5)
    ]
    for compiled in (True, False):
        policy = replace(policies.get("drop-oldest"), compile=compiled)
        fleet = run_fleet(policy, [FleetEpisode(tuple(arrivals), SLOW)], 8, V, max_bytes=2_500)
        assert [log(fleet.senders, i)["dropped_us"].keys() for i in (0, 1)] == [{1, 2}, set()]


def test_each_victim_is_a_draw_of_its_own():
    # Random Drop, five queued, 1000 bytes each; the newcomer needs two of them to go. Each pair of victims, and going
    # itself first or second, is as likely as it should be.
    n = 3_000
    rng = np.random.default_rng(0)
    episodes = []
    for _ in range(n):
        episode, limits = blocked([100, 1_000, 1_000, 1_000, 1_000, 1_000, 2_000], 5_000)
        episodes.append(episode.with_uniforms(rng))
    senders = run(policies.get("random"), episodes, **limits)
    gone = Counter(tuple(sorted(log(senders, i)["dropped_us"])) for i in range(n))
    # Rejected at once: 1/6. Else one of five goes; then itself with 1/5: 5/6 x 1/5 = 1/6. Else two of the five: 2/3.
    assert gone[(6,)] / n == pytest.approx(1 / 6, abs=0.03)
    single = [count for pair, count in gone.items() if len(pair) == 2 and 6 in pair]
    double = [count for pair, count in gone.items() if len(pair) == 2 and 6 not in pair]
    assert (len(single), len(double)) == (5, 10)
    assert np.array(single) / n == pytest.approx(np.full(5, 1 / 30), abs=0.015)
    assert np.array(double) / n == pytest.approx(np.full(10, 1 / 15), abs=0.02)
