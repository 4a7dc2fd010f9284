"""Learned schedulers decide as their weights say; ``test_weights`` has their files."""

from dataclasses import replace

import numpy as np
import pytest
from cases import VALUES, cases, log, order, same
from hypothesis import given
from hypothesis import strategies as st
from topic_cases import observed, topic_cases
from weight_cases import random_weights, score

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.buffer import ACCEPT, HOLD, REJECT
from bufgym.model.link import Link
from bufgym.model.topics import Topic
from bufgym.policies import learned_topics
from bufgym.policies.learned_topics import NAMES, TopicWeights
from bufgym.policies.registry import ClientSettings, Policy
from bufgym.scenario import Episode, messages
from bufgym.sim import run
from bufgym.traces import Trace

V = qoi.exponential(0.618)


@st.composite
def schedulers(draw):
    """Any fields in any order, the context's alone included; with and without a hidden layer."""
    fields = draw(st.lists(st.sampled_from(NAMES), min_size=1, max_size=6, unique=True))
    widths = draw(st.sampled_from([(), (), (1,), (3,), (8,)]))
    return random_weights(TopicWeights, fields, *widths, seed=draw(st.integers(0, 2**32)))


def scores(whole, net, buffer, arrival, arriving):
    """Of every place of the queue, the newcomer's last."""
    n = buffer.capacity + 1
    seen = {name: np.broadcast_to(each, n) for name, each in observed(buffer, arrival, arriving).items()}
    return [score(net, [seen[name][k] for name in whole.fields]) for k in range(n)]


def with_room(buffer, arrival, rest):
    """Whether the newcomer would fit if the ``rest`` were all that is queued."""
    own = sum(m.topic == arrival.topic for m in rest)
    bytes_then = sum(int(m.size_bytes) for m in rest) + int(arrival.size_bytes)
    enough = bytes_then <= buffer.max_bytes
    return len(rest) < buffer.capacity and own < buffer.topics[arrival.topic].limit and enough


def may_go(buffer, arrival, k):
    """Whether this one and others that may be dropped make room, of its own topic while that is at its limit."""
    free = [m for m in buffer.slots if buffer.topics[m.topic].no_drop == 0]
    own = [m for m in buffer.slots if m.topic == arrival.topic]
    enough = with_room(buffer, arrival, [m for m in buffer.slots if buffer.topics[m.topic].no_drop == 1])
    within = len(own) < buffer.topics[arrival.topic].limit or buffer.slots[k].topic == arrival.topic
    return enough and within and any(m.seq == buffer.slots[k].seq for m in free)


def twin(whole):
    """All candidates are scored, the best is searched for afterwards."""

    def on_arrival(buffer, arrival, memory):
        stays = buffer.topics[arrival.topic].no_drop == 1
        drops = scores(whole, whole.drop, buffer, arrival, True)
        choices = [(drops[k], k) for k in range(len(buffer.slots)) if may_go(buffer, arrival, k)]
        choices += [] if stays else [(drops[-1], REJECT)]
        best = max((value for value, _ in choices), default=-np.inf)
        accepted = scores(whole, whole.accept, buffer, arrival, True)[-1]
        if with_room(buffer, arrival, buffer.slots) and (stays or accepted >= best):
            return ACCEPT
        return next((decision for value, decision in choices if value == best), REJECT)

    def on_send(buffer, memory):
        topics = [m.topic for m in buffer.slots]
        kept = [k for k, topic in enumerate(topics) if buffer.topics[topic].no_drop == 1]
        if kept:
            return kept[0]  # that is not learned
        oldest = [k for k, topic in enumerate(topics) if topic not in topics[:k]]
        sends = scores(whole, whole.send, buffer, buffer.slots[0], False)
        return max(oldest, key=lambda k: (sends[k], -k), default=HOLD)

    return Policy("twin", on_arrival, on_send=on_send)


@pytest.mark.kernels
@given(topic_cases(min_topics=2, max_messages=25), schedulers(), st.integers(1, 20))
def test_decides_as_its_twin_compiled_and_not(case, whole, capacity):
    case = replace(case, case=replace(case.case, capacity=capacity), client=ClientSettings())
    policy = learned_topics.policy("random-weights", whole)
    ours, again, memory = case.run(policy), case.senders(), policy.new_memory(1, capacity)
    memory[:] = np.nan  # what it held before does not matter
    again.run(policy, memory)
    assert same(ours, again)
    assert same(ours, case.run(twin(whole)))
    assert same(ours, case.run(replace(policy, compile=False)))
    if case.case.episode.first_decision == 0 and case.case.episode.last_decision > 10**6:
        assert int(ours.batch.senders["invalid"][0]) == 0


@pytest.mark.kernels
@given(cases(max_messages=25), VALUES, schedulers())
def test_on_one_queue_it_drops_its_oldest_first_in_first_out(case, v, whole):
    policy = learned_topics.policy("random-weights", whole)
    assert same(case.run(policy, v), case.run(policies.get("fifo"), v))
    assert same(case.run(policy, v), case.run(replace(policy, compile=False), v))


def linear(**skips):
    """No hidden layer: what each network makes of a field, as drop_loss=-10; what fits is accepted."""
    fields = tuple(dict.fromkeys(name.split("_", 1)[1] for name in skips)) or ("rank",)
    whole = random_weights(TopicWeights, fields)
    for net in (whole.drop, whole.accept, whole.send):
        net.skip[:], net.bias[:] = 0, 0
    for name, number in skips.items():
        which, field = name.split("_", 1)
        getattr(whole, which).skip[fields.index(field)] = number
    whole.accept.bias[0] = 100
    return learned_topics.policy("linear", whole)


HIGH_AND_LOW = (Topic("low", priority=1), Topic("high", priority=5), Topic("kept", priority=2, no_drop=True))


def ten_messages():
    """Topics 0 1 2 0 1 2 ... every 10 us, 1 byte each; the link carries nothing for 1 ms, then a byte in 100 us."""
    arrivals = messages(10 * np.arange(10), np.ones(10, np.int64))
    arrivals["topic"] = np.arange(10) % 3
    return Episode(arrivals, Link(Trace("late", np.array([0, 1_000, 101_000]), np.array([0, 0, 1_000]), after="hold")))


@pytest.mark.kernels
def test_sends_and_drops_by_hand():
    """L = 4: 0 is taken; 1 2 3 4 are queued. By the highest priority kept and sent: 3, then nothing but 0s may go."""
    policy = linear(drop_priority=-1, drop_rank=-0.01, send_priority=1)
    senders = run(policy, [ten_messages()], 4, V, topics=HIGH_AND_LOW)
    # 5 (kept) drives out 3 (low); 6 (low) is rejected; 7 (high) and 8 (kept) drive out 1 and 4, the oldest high ones;
    # 9 (low) is rejected. Queued are 2 5 7 8: the no_drop ones go first.
    assert sorted(log(senders)["dropped_us"].items()) == [(1, 70), (3, 50), (4, 80), (6, 60), (9, 90)]
    assert order(senders) == [0, 2, 5, 8, 7]
    # By the lowest priority sent: 8, and 7 last.
    other = linear(drop_priority=-1, drop_rank=-0.01, send_priority=-1)
    assert order(run(other, [ten_messages()], 4, V, topics=HIGH_AND_LOW)) == [0, 2, 5, 8, 7]
