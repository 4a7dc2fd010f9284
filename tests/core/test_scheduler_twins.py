"""Schedulers against their slow twins, and every policy on several topics: nothing is lost on any of them."""

from __future__ import annotations

from dataclasses import replace

import naive_schedulers
import numpy as np
import pytest
from cases import cases, same
from hypothesis import given
from hypothesis import strategies as st
from test_schedulers import ALL, NAMES, V, count

from bufgym import policies
from bufgym.model.buffer import HOLD
from bufgym.model.topics import Topic
from bufgym.sim import NEVER, Senders


@st.composite
def topics_cases(draw, **limits):
    """(case, topics): random episodes of three topics with all that a topic may have."""
    case = draw(cases(**limits))
    window, ack_delay_us = draw(st.integers(1, 4)), draw(st.sampled_from([0, 0, 2_000, 30_000]))
    case = replace(case, episode=replace(case.episode, window=window, ack_delay_us=ack_delay_us))
    made = []
    for name in "ABC":
        no_drop = draw(st.booleans())
        rules = {
            "priority": draw(st.sampled_from([0.0, 1.0, 1.0, 2.0, 3.5])),
            "weight": draw(st.sampled_from([None, 0.0, 1.0, 4.0])),
            "deadline_s": draw(st.sampled_from([None, 0.001, 0.02])),
            "rate_limit_hz": draw(st.sampled_from([None, None, 150.0, 2_000.0])),
        }
        if not no_drop:
            rules["limit"] = draw(st.sampled_from([None, None, 1, 2]))
        made.append(Topic(name, no_drop=no_drop, **rules))
    return case, made


def run_topics(case, topics, policy):
    capacity = len(case.twin_messages) if policy.unbounded else case.capacity
    limits = {"max_bytes": case.max_bytes, "decide_at": case.decide_at}
    senders = Senders(1, capacity, V, max_messages=len(case.twin_messages), topics=topics, **limits)
    senders.load(0, case.episode)
    senders.run(policy)
    return senders


def listed(slots):
    names = {"seq": "seq", "us": "arrival_us", "bytes": "size_bytes", "topic": "topic"}
    return [{key: int(message[name]) for key, name in names.items()} for message in slots]


def beside_its_twin(name, case, topics):
    """The policy, each of whose answers is held against its twin's."""
    policy = policies.get(name)
    twin = naive_schedulers.TWINS[name](topics, case.capacity, case.max_bytes)

    def on_arrival(buffer, arrival, memory):
        decision, queue = policy.on_arrival(buffer, arrival, memory), listed(buffer.slots)
        expected, victim = twin.decide(queue, listed([arrival])[0]), queue[decision] if decision >= 0 else None
        assert expected == (victim if decision >= 0 else decision)
        return decision

    def on_send(buffer, memory):
        k, queue = policy.on_send(buffer, memory), listed(buffer.slots)
        expected = twin.choose(queue, int(buffer.now_us), int(buffer.in_flight), int(buffer.window))
        assert expected == (None if k == HOLD else queue[k])
        return k

    return replace(policy, on_arrival=on_arrival, on_send=on_send, compile=False)


@pytest.mark.kernels
@pytest.mark.parametrize("name", NAMES)
@given(topics_cases(max_messages=25))
def test_agrees_with_its_twin(name, drawn):
    case, topics = drawn
    senders = run_topics(case, topics, beside_its_twin(name, case, topics))
    # What came of it is what the policy itself does, compiled.
    assert same(senders, run_topics(case, topics, policies.get(name)))
    if case.episode.first_decision == 0 and case.episode.last_decision > len(case.twin_messages):
        assert count(senders, "invalid") == 0


def accounts(senders, topics):
    """For each topic, how many messages were transmitted, are being sent, are queued and were dropped; each is one."""
    sender, batch = np.asarray(senders.batch.senders)[0], senders.batch
    n = int(sender["arrivals"])
    rows, topic = np.asarray(batch.log[0])[:n], np.asarray(batch.arrivals[0])["topic"][:n]
    queued = np.zeros(n, bool)
    queued[np.asarray(batch.slots[0])["seq"][sender["first"] : sender["first"] + sender["occupancy"]]] = True
    transmitted, lost = rows["transmitted_us"] != NEVER, rows["dropped_us"] != NEVER
    sending = (rows["dequeued_us"] != NEVER) & ~transmitted
    entry = np.stack([transmitted, sending, queued, lost])
    assert (entry.sum(0) == 1).all()
    return [entry[:, topic == k].sum(1).tolist() for k in range(len(topics))]


@pytest.mark.parametrize("name", ALL)
@given(topics_cases(max_bytes=False, max_messages=25))
def test_every_policy_runs_on_topics_and_nothing_is_lost(name, drawn):
    case, topics = drawn
    senders = run_topics(case, topics, policies.get(name))
    rows = np.asarray(senders.batch.topics)[0]
    for k, (delivered, sending, queued, lost) in enumerate(accounts(senders, topics)):
        assert rows["arrived"][k] == delivered + sending + queued + lost
        assert rows["dequeued"][k] == delivered + sending
        assert rows["queued"][k] == queued
    assert count(senders, "next") == len(case.twin_messages)
    no_drop_is_kept_while_others_could_go(senders, topics)


def no_drop_is_kept_while_others_could_go(senders, topics):
    n = int(senders.batch.senders[0]["arrivals"])
    rows, arrivals = np.asarray(senders.batch.log[0])[:n], np.asarray(senders.batch.arrivals[0])[:n]
    free = np.array([not topic.no_drop for topic in topics])[arrivals["topic"]]
    for lost in np.flatnonzero(~free & (rows["dropped_us"] != NEVER) & (rows["limited"] == 0)):
        at_us = arrivals["arrival_us"][lost]
        assert rows["dropped_us"][lost] == at_us  # rejected when it came: no_drop is never evicted
        later = [(rows[field] == NEVER) | (rows[field] > at_us) for field in ("dequeued_us", "dropped_us")]
        assert not (free & later[0] & later[1])[:lost].any()
