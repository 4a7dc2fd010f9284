"""gap-priority decides as its text says, and keeps what finds room while the link carries what comes."""

import math
from dataclasses import replace

import numpy as np
import pytest
from cases import VALUES, cases, same
from hypothesis import given
from hypothesis import strategies as st
from topic_cases import topic_cases

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.buffer import ACCEPT, HOLD, REJECT, loss
from bufgym.model.topics import Topic
from bufgym.policies.gap_priority import PARAMETERS
from bufgym.policies.registry import ClientSettings, Policy
from bufgym.scenario import Client, Stream
from bufgym.scenario.numbered import draw
from bufgym.sim import run
from bufgym.traces import Trace

kernels = pytest.mark.kernels
RULE = policies.get("gap-priority")


def some(seed):
    """The rule with other weights."""
    numbers = np.exp(np.random.default_rng(seed).normal(0, 1, len(PARAMETERS)))
    return RULE.with_parameters(
        **{name: number * factor for (name, number), factor in zip(PARAMETERS.items(), numbers, strict=True)}
    )


def features(buffer, message, worth):
    """The logarithms that both sums are made of, by name."""
    topic, s = buffer.topics[message.topic], 1e-6
    highest, weight = buffer.topics["priority"].max(), buffer.topics["weight"].max()
    return {
        "priority": max(math.log(topic.priority / highest), -3) if topic.priority > 0 else -3.0,
        "gain": math.log(worth / max(1e-12, weight) + 1e-3),
        "size": math.log(message.size_bytes / max(buffer.arrival_bytes, 1)),
        "wait": math.log(s * (buffer.now_us - topic.last_dequeue_us) + 1e-3),
        "silence": math.log(s * (buffer.now_us - topic.dequeued_arrival_us * (topic.dequeued > 0)) + 1e-3),
        "age": math.log(s * (buffer.now_us - message.arrival_us) + 1e-3),
        "queued": math.log1p(topic.queued),
    }


def total(buffer, message, worth, numbers, kind):
    """The sum of what speaks for sending, or for dropping, a message."""
    signs = {"send": {"size": -1}, "drop": {"priority": -1, "gain": -1, "wait": -1}}[kind]
    found = features(buffer, message, worth)
    return sum(
        signs.get(name, 1) * numbers[f"{kind}_{name}"] * found[name] for name in found if f"{kind}_{name}" in numbers
    )


def with_room(buffer, arrival, rest):
    """Whether the newcomer would fit if the ``rest`` were all that is queued."""
    own = sum(m.topic == arrival.topic for m in rest)
    enough = sum(int(m.size_bytes) for m in rest) + int(arrival.size_bytes) <= buffer.max_bytes
    return len(rest) < buffer.capacity and own < buffer.topics[arrival.topic].limit and enough


def may_go(buffer, arrival, k):
    """Whether this one and others that may be dropped make room, of its own topic while that is at its limit."""
    own = [m for m in buffer.slots if m.topic == arrival.topic]
    enough = with_room(buffer, arrival, [m for m in buffer.slots if buffer.topics[m.topic].no_drop == 1])
    within = len(own) < buffer.topics[arrival.topic].limit or buffer.slots[k].topic == arrival.topic
    return enough and within and buffer.topics[buffer.slots[k].topic].no_drop == 0


def reference(numbers):
    """All candidates are weighed, the heaviest is searched for afterwards; near ties are told to the test."""
    near, comes = [], [0.0, 0]

    def heaviest(choices):
        ranked = sorted((-value, place, decision) for place, (value, decision) in enumerate(choices))
        near.append(len(ranked) > 1 and 0 < ranked[1][0] - ranked[0][0] < 1e-9)
        return -ranked[0][0], ranked[0][2]

    def on_arrival(buffer, arrival, memory):
        s, room = len(buffer.slots), with_room(buffer, arrival, buffer.slots)
        if buffer.evictions == 0:
            us = buffer.now_us - comes[1]
            comes[:] = comes[0] + (arrival.size_bytes - comes[0] * us) / (us + 5e6), buffer.now_us
        rate = buffer.long_rate_bytes_per_s / 1e6
        near.append(abs(rate - comes[0]) < 1e-12)
        if room and (rate <= 0 or rate >= comes[0]):
            return ACCEPT
        going = [k for k in range(s) if may_go(buffer, arrival, k)]
        choices = [(total(buffer, buffer.slots[k], loss(buffer, arrival, k), numbers, "drop"), k) for k in going]
        if buffer.topics[arrival.topic].no_drop == 0:
            choices.append((total(buffer, arrival, loss(buffer, arrival, s), numbers, "drop"), REJECT))
        best, decision = heaviest(choices) if choices else (-np.inf, REJECT)
        return ACCEPT if room and best <= numbers["room"] else decision

    def on_send(buffer, memory):
        topics = [m.topic for m in buffer.slots]
        kept = [k for k, topic in enumerate(topics) if buffer.topics[topic].no_drop == 1]
        oldest = [k for k, topic in enumerate(topics) if topic not in topics[:k]]
        choices = [(total(buffer, buffer.slots[k], buffer.slots[k].gain, numbers, "send"), k) for k in oldest]
        return kept[0] if kept else heaviest(choices)[1] if choices else HOLD

    return Policy("reference model", on_arrival, on_send=on_send, reads_rate=True), near


@kernels
@given(topic_cases(min_topics=2, max_messages=25), st.integers(0, 2**32), st.integers(1, 20))
def test_decides_as_its_reference_compiled_and_not(case, seed, capacity):
    case = replace(case, case=replace(case.case, capacity=capacity), client=ClientSettings())
    policy = some(seed)
    ours = case.run(policy)
    other, near = reference(policy.parameters)
    assert same(ours, case.run(other)) or any(near)
    assert same(ours, case.run(replace(policy, compile=False)))
    if case.case.episode.first_decision == 0 and case.case.episode.last_decision > 10**6:
        assert int(ours.batch.senders["invalid"][0]) == 0


@kernels
@given(cases(max_messages=25), VALUES)
def test_on_one_queue_it_drops_its_oldest_first_in_first_out(case, v):
    assert same(case.run(RULE, v), case.run(policies.get("fifo"), v))


def client(topics, rate_hz, size_bytes, bytes_per_s, *, sizes_differ=False):
    """Topics that all publish at the same moments, over a steady link."""
    sizes = [size_bytes * (1 + k % 4 if sizes_differ else 1) for k in range(topics)]
    streams = [
        Stream(Topic(f"{k}", priority=1 + k % 3, weight=1 + k % 2), rate_hz, size) for k, size in enumerate(sizes)
    ]
    link = Trace.steps([(60.0, bytes_per_s)])
    return Client(tuple(streams), (link,), duration_s=20.0, propagation_us=0, value=qoi.exponential(0.5)), sum(
        sizes
    ) * rate_hz


def dropped(made, capacity):
    """Messages dropped of an episode, and all of them."""
    episode = draw(made, 1)
    senders = run(RULE, [episode], capacity, made.value, topics=made.topics)
    return int((np.asarray(senders.batch.log["dropped_us"])[0, : len(episode.arrivals)] >= 0).sum()), len(
        episode.arrivals
    )


@pytest.mark.parametrize("load", [0.007, 0.1, 0.5, 0.9])
@pytest.mark.parametrize("topics", [1, 2, 4, 10, 30, 64])
@pytest.mark.parametrize("sizes_differ", [False, True])
def test_nothing_is_dropped_where_the_link_carries_what_comes(topics, load, sizes_differ):
    """Topics at 10 Hz publish at once, so a burst of one message each finds room and leaves before the next one."""
    made, comes = client(topics, 10.0, 1_000, 1_000_000, sizes_differ=sizes_differ)
    link = Trace.steps([(60.0, round(comes / load))])
    lost, messages = dropped(replace(made, traces=(link,)), capacity=topics + 1)
    assert messages >= 199 * topics and lost == 0


@pytest.mark.parametrize("topics", [2, 10, 64])
def test_twice_what_the_link_carries_loses_about_half(topics):
    """So it does drop: of twice as many bytes as can cross, half are lost at least, save what the queue still holds."""
    made, comes = client(topics, 10.0, 1_000, 1_000_000)
    lost, messages = dropped(replace(made, traces=(Trace.steps([(60.0, round(comes / 2))]),)), capacity=topics + 1)
    assert 0.4 * messages < lost < 0.65 * messages
