"""A guided scheduler decides as its numbers say; ``test_weights`` has its file."""

import math
from dataclasses import replace

import numpy as np
import pytest
from cases import VALUES, cases, same
from hypothesis import given
from hypothesis import strategies as st
from refusal_cases import refuse
from topic_cases import topic_cases

from bufgym import policies
from bufgym.model import qoi
from bufgym.model.buffer import ACCEPT, HOLD, REJECT, loss
from bufgym.model.topics import NO_DEADLINE_US
from bufgym.policies import guided_topics
from bufgym.policies.guided_topics import FEATURES, INPUTS, OUTPUTS, PLAIN, SchedulerWeights
from bufgym.policies.registry import ClientSettings, Policy

pytestmark = pytest.mark.kernels
V = qoi.exponential(0.618)


def random_scheduler(seed):
    return SchedulerWeights(np.random.default_rng(seed).normal(0, 1, (len(OUTPUTS), len(INPUTS))).astype(np.float32))


def lg(a, b):
    """A logarithm of a ratio, as the text says."""
    return float(np.clip(math.log(a / b), -3, 3)) if a > 0 and b > 0 else 3.0 * (a > 0) - 3.0 * (b > 0)


def numbers(whole, buffer):
    """By name: the plain rule's, plus W c."""
    rate, full = buffer.long_rate_bytes_per_s, len(buffer.slots) / buffer.capacity
    c = {
        "one": 1.0,
        "fill": 2 * max(full, buffer.backlog_bytes / buffer.max_bytes) - 1,
        "load": lg(rate * buffer.period_us, 1e6 * buffer.arrival_bytes),
        "trend": lg(buffer.short_rate_bytes_per_s, rate),
        "stall": math.log1p(buffer.stalled_us / 1e6),
        "drain": lg(buffer.backlog_bytes, rate),
        "service": 2 * buffer.service_ratio - 1,
        "in_flight": 2 * buffer.in_flight / buffer.window - 1,
        "window": 1 - 2 / buffer.window,
    }
    moved = whole.weight.astype(float) @ [c[name] for name in INPUTS]
    return {name: PLAIN.get(name, 0.0) + more for name, more in zip(OUTPUTS, moved, strict=True)}


def weight_of(buffer, message, worth, n, kind):
    """n f, feature by feature."""
    topic, s = buffer.topics[message.topic], 1e-6
    age_us = buffer.now_us - message.arrival_us
    features = {
        "priority": lg(topic.priority, max(1e-12, buffer.topics["priority"].max())),
        "gain": math.log(worth / max(1e-12, buffer.topics["weight"].max()) + 1e-3),
        "size": math.log(message.size_bytes / max(buffer.arrival_bytes, 1)),
        "wait": math.log(s * (buffer.now_us - topic.last_dequeue_us) + 1e-3),
        "silence": math.log(s * (buffer.now_us - topic.dequeued_arrival_us * (topic.dequeued > 0)) + 1e-3),
        "age": math.log(s * age_us + 1e-3),
        "late": min(age_us / topic.deadline_us, 2) if topic.deadline_us < NO_DEADLINE_US else 0.0,
        "queued": math.log1p(topic.queued),
    }
    return sum(n[f"{kind}_{name}"] * features[name] for name in FEATURES)


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


def reference(whole):
    """All candidates are weighed, the heaviest is searched for afterwards; near ties are told to the test."""
    near = []

    def heaviest(choices):
        ranked = sorted((-value, place, decision) for place, (value, decision) in enumerate(choices))
        near.append(len(ranked) > 1 and 0 < ranked[1][0] - ranked[0][0] < 1e-9)
        return -ranked[0][0], ranked[0][2]

    def on_arrival(buffer, arrival, memory):
        n, s = numbers(whole, buffer), len(buffer.slots)
        stays = buffer.topics[arrival.topic].no_drop == 1
        going = [k for k in range(s) if may_go(buffer, arrival, k)]
        choices = [(weight_of(buffer, buffer.slots[k], loss(buffer, arrival, k), n, "drop"), k) for k in going]
        if not stays:
            choices.append((weight_of(buffer, arrival, loss(buffer, arrival, s), n, "drop"), REJECT))
        best, decision = heaviest(choices) if choices else (-np.inf, REJECT)
        return ACCEPT if with_room(buffer, arrival, buffer.slots) and best <= n["room"] else decision

    def on_send(buffer, memory):
        topics = [m.topic for m in buffer.slots]
        kept = [k for k, topic in enumerate(topics) if buffer.topics[topic].no_drop == 1]
        n, oldest = numbers(whole, buffer), [k for k, topic in enumerate(topics) if topic not in topics[:k]]
        sends = [(weight_of(buffer, buffer.slots[k], buffer.slots[k].gain, n, "send"), k) for k in oldest]
        return kept[0] if kept else heaviest(sends)[1] if sends else HOLD

    return Policy("reference model", on_arrival, on_send=on_send, reads_rate=True), near


@given(topic_cases(min_topics=2, max_messages=25), st.integers(0, 2**32), st.integers(1, 20))
def test_decides_as_its_reference_compiled_and_not(case, seed, capacity):
    case = replace(case, case=replace(case.case, capacity=capacity), client=ClientSettings())
    policy = random_scheduler(seed).policy("some")
    ours, again, memory = case.run(policy), case.senders(), policy.new_memory(1, capacity)
    memory[:] = np.nan  # what it held before does not matter
    again.run(policy, memory)
    assert same(ours, again)
    other, near = reference(random_scheduler(seed))
    assert same(ours, case.run(other)) or any(near)
    assert same(ours, case.run(replace(policy, compile=False)))
    if case.case.episode.first_decision == 0 and case.case.episode.last_decision > 10**6:
        assert int(ours.batch.senders["invalid"][0]) == 0


@given(cases(max_messages=25), VALUES)
def test_on_one_queue_it_drops_its_oldest_first_in_first_out(case, v):
    policy = random_scheduler(1).policy("some")
    assert same(case.run(policy, v), case.run(policies.get("fifo"), v))
    assert same(case.run(policy, v), case.run(replace(policy, compile=False), v))


def test_weights_of_another_shape_are_refused():
    refuse(r"must be 17 x 9 finite numbers", SchedulerWeights(np.zeros((2, 3), np.float32)).policy, "some")
    assert len(guided_topics.BASE) == SchedulerWeights.SHAPE[0] and guided_topics.BASE.any()
