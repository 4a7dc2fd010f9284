"""Schedulers against their slow twins, and every policy on several topics: nothing is lost on any of them."""

from dataclasses import replace

import naive_schedulers
import numpy as np
import pytest
from cases import log, order, same, twin_log
from hypothesis import given
from test_topics_twin import hold
from topic_cases import topic_cases

from bufgym import policies
from bufgym.sim import NEVER


def played(case, policy):
    senders = case.senders()
    senders.run(policy)
    return senders


@pytest.mark.kernels
@pytest.mark.parametrize("name", naive_schedulers.TWINS)
@given(topic_cases(min_topics=2, max_messages=30))
def test_agrees_with_its_twin(name, case):
    policy = policies.get(name)
    case = replace(case, client=policy.client, schedules=True, drops_heads=False)
    twin, episode = case.twin(), case.case.episode
    if not policy.client.awaits_acks:  # then the socket takes the next message when the last has crossed
        twin.window, twin.ack_delay_us = 1, 0
    naive_schedulers.TWINS[name](twin)
    twin.run(case.case.twin_messages, episode.first_decision, episode.last_decision)
    senders = played(case, policy)
    assert log(senders) == twin_log(twin)
    assert order(senders) == twin.order
    assert senders.batch.senders["invalid"][0] == twin.invalid
    assert twin.invalid == 0 or episode.first_decision > 0 or episode.last_decision < len(case.case.twin_messages)
    assert same(senders, played(case, replace(policy, compile=False)))


@pytest.mark.parametrize("name", [name for name in policies.names() if policies.get(name).privileged is None])
@given(topic_cases(min_topics=2, max_messages=25))
def test_every_policy_runs_on_topics_and_nothing_is_lost(name, case):
    policy = policies.get(name)
    capacity = len(case.case.twin_messages) if policy.unbounded else case.case.capacity
    case = replace(case, client=policy.client, case=replace(case.case, capacity=capacity, max_bytes=None))
    senders = played(case, policy)
    hold(case, senders)
    assert senders.batch.senders["next"][0] == len(case.case.twin_messages)
    # No no_drop message goes while another that could go is queued.
    rows, arrivals = np.asarray(senders.batch.log[0]), case.case.episode.arrivals
    free = np.array([not topic.no_drop for topic in case.topics])[arrivals["topic"]]
    for lost in np.flatnonzero(~free & (rows["dropped_us"] != NEVER) & (rows["limited"] == 0)):
        at_us = arrivals["arrival_us"][lost]
        assert rows["dropped_us"][lost] == at_us  # rejected when it came: no_drop is never evicted
        later = [(rows[field] == NEVER) | (rows[field] > at_us) for field in ("dequeued_us", "dropped_us")]
        assert not (free & later[0] & later[1])[:lost].any()
