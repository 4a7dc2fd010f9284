"""The sender with topics: event by event against its twin, and what must hold whatever is decided."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from cases import ANYTHING, VALUES, cases, log, order, same, twin_log
from hypothesis import given
from hypothesis import strategies as st
from topic_cases import choice, decision, topic_cases, unwanted

from bufgym import policies, sim
from bufgym.model.buffer import (
    ACCEPT,
    HOLD,
    REJECT,
    after,
    arrival_gain,
    before,
    is_first,
    loss,
    motion_gaps,
    time_gaps,
)
from bufgym.model.link import FOREVER
from bufgym.model.topics import Topic
from bufgym.policies.registry import ClientSettings

pytestmark = pytest.mark.kernels


@given(topic_cases())
def test_agrees_with_twin_event_by_event(case):
    L = case.case.capacity

    def check(event, senders, twin):
        batch = senders.batch
        sim.credit(batch, 0, int(batch.senders[0]["now_us"]))
        agree(senders, twin)
        view = sim.python_view(sim.named(batch), 0)
        assert (view.window, view.in_flight) == (case.case.episode.window, len(twin.in_flight))
        assert (view.busy, view.left_bytes) == (int(bool(twin.socket)), twin.left_bytes())
        if event == "decision":
            agree_on_gaps(senders, twin)
        if event == "send":
            can = [twin.sendable(m) for m in twin.slots()]
            assert [sim.can_send(batch, 0, k) for k in range(-1, L + 1)] == [False, *can] + [False] * (L + 1 - len(can))
            assert sim.can_hold(batch, 0) == twin.may_hold()

    senders, twin = case.beside_its_twin(check)
    agree_on_log(senders, twin)
    until = int(senders.batch.senders[0]["now_us"]) + 5_000
    sim.credit(senders.batch, 0, until)
    for k in range(len(case.topics)):
        sim.age_until(senders.batch, 0, k, until)
    agree(senders, twin, until, to_the_end=True)


def agree(senders, twin, until=None, to_the_end=False):
    """The same is queued and in flight, nothing has been lost, and the sums are those from scratch."""
    batch = senders.batch
    sender = np.asarray(batch.senders)[0]
    until = twin.now if until is None else until
    slots = np.asarray(batch.slots[0])[sender["first"] : sender["first"] + sender["occupancy"]]
    assert sender["now_us"] == twin.now
    assert slots["seq"].tolist() == [m["seq"] for m in twin.slots()]
    assert sender["backlog_bytes"] == sum(m["bytes"] for m in twin.slots())
    assert sender["dequeued"] - sender["acked"] == len(twin.in_flight)
    assert sender["busy"] == len(twin.socket)
    assert (sender["rejected"], sender["evicted"], sender["invalid"]) == (
        twin.rejected,
        twin.evicted,
        twin.invalid,
    )
    assert sender["retained_gain"] == pytest.approx(twin.retained_gain(), abs=1e-9)
    assert sender["delivered_gain"] == pytest.approx(twin.delivered_gain(until), abs=1e-9)
    for slot, message in zip(slots, twin.slots(), strict=True):
        last = twin.kept_before(message)
        gain = twin.gain(twin.lane(message), [last, message]) if last else 0.0
        assert slot["gain"] == pytest.approx(gain, abs=1e-12)
    if twin.one_queue:
        return
    assert sender["aged"] == pytest.approx(twin.aged(until, to_the_end), rel=1e-9, abs=1e-12)
    assert sender["late"] == pytest.approx(twin.late(until))
    for k, row in enumerate(np.asarray(batch.topics[0])[: len(twin.rules)]):
        assert (row["queued"], row["arrived"], row["dequeued"], row["received"]) == (
            len(twin.queues[k]),
            len(twin.arrived[k]),
            len(twin.sent[k]),
            len(twin.received(k, until)),
        )
        if twin.sent[k]:
            last = twin.sent[k][-1]
            assert (row["dequeued_arrival_us"], row["dequeued_x"], row["last_dequeue_us"]) == (
                last["us"],
                last["x"],
                twin.dequeued[last["seq"]],
            )


def agree_on_gaps(senders, twin):
    """What a policy reads about the newcomer and every slot."""
    seen = sim.named(senders.batch)
    buffer, arrival = sim.python_view(seen, 0), seen.arrivals[0, seen.senders[0].next]
    newcomer, slots = twin.newcomer, twin.slots()
    reference, last = twin.reference(), twin.kept_before(newcomer)
    assert (buffer.dequeued_arrival_us, buffer.dequeued_x) == (reference["us"], reference["x"])
    gain = twin.gain(twin.lane(newcomer), [last, newcomer]) if last else 0.0
    assert arrival_gain(buffer, arrival) == pytest.approx(gain, abs=1e-12)
    assert sim.has_room(senders.batch, 0) == twin.fits(newcomer)
    assert sim.can_reject(senders.batch, 0) == (not twin.must_keep(newcomer))
    evictable = twin.evictable(newcomer)
    for k, message in enumerate([*slots, newcomer]):
        lane = twin.lane(message)
        (a_us, b_us), (a, b) = twin.gaps(message, "us"), twin.gaps(message, "x")
        assert time_gaps(buffer, arrival, k) == (a_us, b_us)
        assert motion_gaps(buffer, arrival, k) == (a, b)
        v = twin.rules[lane].v
        assert loss(buffer, arrival, k) == pytest.approx(twin.rules[lane].weight * (v(a) + v(b) - v(a + b)), abs=1e-12)
        own = [j for j, m in enumerate(slots) if twin.lane(m) == lane]
        assert before(buffer, k, lane) == max([j for j in own if j < k], default=-1)
        if k < len(slots):
            assert after(buffer, k, lane) == min([j for j in own if j > k], default=len(slots))
            assert is_first(buffer, k) == (k == own[0])
            assert sim.can_evict(senders.batch, 0, k) == (message in evictable)


def agree_on_log(senders, twin):
    assert {k for k, entry in enumerate(np.asarray(senders.batch.log[0])) if entry["limited"]} == twin.limited
    assert log(senders) == twin_log(twin)
    assert order(senders) == twin.order


@given(topic_cases(max_messages=150), st.booleans())
def test_rollouts_agree_with_twin(case, compiled):
    twin = case.run_twin()
    senders = case.senders()
    senders.run(case.policy(compile=compiled))
    agree_on_log(senders, twin)
    agree(senders, twin, FOREVER)


@given(topic_cases())
def test_the_same_inputs_make_the_same_run(case):
    first, again = case.senders(), case.senders()
    policy = case.policy(compile=True)
    first.run(policy)
    again.run(replace(policy, compile=False))
    assert same(first, again)
    again.load(0, case.case.episode)  # which forgets the run before
    again.run(policy)
    assert same(first, again)
    for name in ("aged", "late", "invalid"):
        assert first.batch.senders[0][name] == again.batch.senders[0][name]
    assert (np.asarray(first.batch.topics) == np.asarray(again.batch.topics)).all()


@given(topic_cases(), st.randoms(use_true_random=False))
def test_invariants_after_every_event(case, chance):
    senders = case.senders()
    batch, sender = senders.batch, senders.batch.senders[0]
    capacity, event, now_us = case.case.capacity, None, 0
    # Arrivals that ask nobody may find no room; where all ask, and are given what is possible, nothing is impossible.
    everyone = case.case.episode.first_decision == 0 and case.case.episode.last_decision > len(case.case.twin_messages)
    while event != sim.END:
        event = sim.next_event(batch, None, 0)
        assert sender["now_us"] >= now_us
        now_us = int(sender["now_us"])
        hold(case, senders)
        if event == sim.DECISION:
            possible = [k for k in range(capacity) if sim.can_evict(batch, 0, k)]
            possible += [REJECT] * sim.can_reject(batch, 0) + [ACCEPT] * sim.has_room(batch, 0)
            kept_if_possible(case, senders, chance.choice(possible), possible=True)
        elif event == sim.SEND:
            possible = [k for k in range(capacity) if sim.can_send(batch, 0, k)] + [HOLD] * sim.can_hold(batch, 0)
            assert sim.answer_send(batch, 0, chance.choice(possible))
        elif event == sim.DEQUEUE:
            sim.answer_dequeue(batch, 0, chance.random() < 0.5)
        hold(case, senders)
    assert sender["invalid"] == 0 or not everyone
    assert sender["next"] == len(case.case.twin_messages)
    assert sim.next_event(batch, None, 0) == sim.END  # and stays there


@given(topic_cases())
def test_invariants_under_impossible_decisions(case):
    senders = case.senders()
    batch, event = senders.batch, None
    while event != sim.END:
        event = sim.next_event(batch, None, 0)
        if event == sim.DECISION:
            uniform = float(batch.arrivals[0, batch.senders[0]["next"]]["uniform"])
            kept_if_possible(case, senders, decision(uniform, case.case.capacity))
        elif event == sim.SEND:
            sender = batch.senders[0]
            k = choice(int(sender["now_us"]), int(sender["occupancy"]), int(sender["dequeued"]), case.case.capacity)
            sim.answer_send(batch, 0, k)
        elif event == sim.DEQUEUE:
            sim.answer_dequeue(batch, 0, True)
        hold(case, senders)


def kept_if_possible(case, senders, answer, possible=False):
    """No decision drops a no_drop message but a newcomer that has no room even without all droppable ones."""
    batch = senders.batch
    sender = np.asarray(batch.senders)[0].copy()
    slots = np.asarray(batch.slots[0])[sender["first"] : sender["first"] + sender["occupancy"]].copy()
    seq = int(sender["next"])
    newcomer = np.asarray(batch.arrivals[0])[seq].copy()
    assert sim.decide(batch, 0, answer) or not possible
    gone = np.asarray(batch.log[0])["dropped_us"] != sim.NEVER
    no_drop = [rules.no_drop for rules in case.topics] or [False] * 3  # one queue ignores the messages' topics
    assert not any(gone[m["seq"]] and no_drop[m["topic"]] for m in slots)
    if not (gone[seq] and no_drop[newcomer["topic"]]):
        return
    spare = (case.case.max_bytes or 2**62) - sender["backlog_bytes"] - newcomer["size_bytes"]
    droppable = [m["size_bytes"] for m in slots if not no_drop[m["topic"]]]
    assert spare + sum(droppable) < 0 or (not droppable and len(slots) == case.case.capacity)


def hold(case, senders):
    """arrived = delivered + in transmission + buffered + dropped in each topic; windows, limits and order are kept."""
    batch = senders.batch
    sender = np.asarray(batch.senders)[0]
    arrived, first, queued = int(sender["next"]), int(sender["first"]), int(sender["occupancy"])
    rows = np.asarray(batch.log[0])[:arrived]
    lanes = case.topics or (Topic("all"),)
    topic = np.asarray(case.case.episode.arrivals)["topic"] * bool(case.topics)
    x = np.asarray(case.case.episode.arrivals)["x"]
    slots = np.asarray(batch.slots[0])[first : first + queued]
    times = ("dropped_us", "transmitted_us", "dequeued_us")
    dropped, transmitted, dequeued = (rows[name] != sim.NEVER for name in times)
    assert (transmitted <= dequeued).all() and not (dropped & dequeued).any()
    assert not (dropped | dequeued)[slots["seq"]].any()
    assert (dequeued & ~transmitted).sum() == sender["busy"]
    assert dropped.sum() == sender["rejected"] + sender["evicted"]
    assert queued <= case.case.capacity
    assert sender["backlog_bytes"] == slots["size_bytes"].sum() <= (case.case.max_bytes or 2**62)
    in_flight = batch.order[0, sender["acked"] : sender["dequeued"]]
    if case.client.flush_no_drop:
        # Only no_drop messages were sent beyond the window.
        in_flight = in_flight[case.case.episode.window :]
        assert all(lanes[k].no_drop for k in topic[in_flight])
    else:
        assert len(in_flight) <= case.case.episode.window
    assert (np.diff(slots["seq"]) > 0).all()
    gain = 0.0
    for k, rules in enumerate(lanes):
        of, own = topic[:arrived] == k, topic[slots["seq"]] == k
        assert of.sum() == (of & (dropped | dequeued)).sum() + own.sum()
        assert own.sum() <= (rules.limit or case.case.capacity)
        if case.topics:
            assert (of.sum(), own.sum()) == (batch.topics[0, k]["arrived"], batch.topics[0, k]["queued"])
        sent = [seq for seq in batch.order[0, : sender["dequeued"]].tolist() if topic[seq] == k]
        kept = sent + slots["seq"][own].tolist()
        assert kept == sorted(kept)  # in order of arrival
        v = rules.value or case.v
        gain += rules.share * sum(v(x[b] - x[a]) for a, b in pairwise(kept))
    # What is retained is what everything kept would add if it were delivered.
    assert sender["retained_gain"] == pytest.approx(gain, abs=1e-9)


def head(buffer, memory):
    """The scheduler of a first in, first out queue."""
    return 0


def holds_sometimes(buffer, memory):
    return int(buffer.now_us % 3 > 0) - 1


PLAIN = [
    p
    for p in (*map(policies.get, policies.names()), ANYTHING)
    if p.privileged is None and not p.unbounded and not any(p.work) and not p.schedules and p.client == ClientSettings()
]
"""All policies of one queue that know nothing beforehand, and one that decides at random."""


def one_topic(case):
    arrivals = case.episode.arrivals.copy()
    arrivals["topic"] = 0
    return replace(case.episode, arrivals=arrivals)


@given(cases(), VALUES, st.sampled_from([None, head, holds_sometimes]), st.data())
def test_one_topic_without_rules_is_a_plain_sender(case, v, on_send, data):
    limits = {"max_bytes": case.max_bytes, "decide_at": case.decide_at}
    for policy in data.draw(st.lists(st.sampled_from(PLAIN), min_size=4, max_size=4)):
        scheduled = policy if on_send is None else replace(policy, on_send=on_send)
        plain = sim.run(policy if on_send is head else scheduled, [case.episode], case.capacity, v, **limits)
        topics = sim.run(scheduled, [one_topic(case)], case.capacity, v, topics=[Topic("only")], **limits)
        assert same(plain, topics), policy.name


@given(cases(), VALUES, st.integers(1, 4), st.sampled_from([0, 1, 3_000]))
def test_one_topic_without_rules_has_the_same_window(case, v, window, ack_delay_us):
    for on_send in (head, holds_sometimes):
        policy = replace(PLAIN[-1], on_send=on_send)
        windowed = {"window": window, "ack_delay_us": ack_delay_us}
        plain = sim.run(policy, [replace(case.episode, **windowed)], case.capacity, v)
        topics = sim.run(policy, [replace(one_topic(case), **windowed)], case.capacity, v, topics=[Topic("only")])
        assert same(plain, topics)
