"""The sender with topics and its schedulers: against their reference models, and what must hold whatever is decided."""

from dataclasses import replace
from itertools import pairwise

import naive_schedulers
import numpy as np
import pytest
from cases import ANYTHING, VALUES, cases, log, order, reference_log, same
from hypothesis import given
from hypothesis import strategies as st
from topic_cases import topic_cases

from bufgym import jit, policies, sim
from bufgym.envs import SenderEnv
from bufgym.model.buffer import ACCEPT, HOLD, REJECT, arrival_gain, before, gaps, is_first, loss, motion_gaps
from bufgym.model.buffer import after as slot_after
from bufgym.model.link import FOREVER
from bufgym.model.topics import Topic
from bufgym.policies.registry import ClientSettings
from bufgym.scenario.client import Client, Stream
from bufgym.sim import decisions
from bufgym.sim.rollout import python_view
from bufgym.sim.rules import age_topic_until, age_until
from bufgym.sim.socket import credit
from bufgym.sim.state import DECISION, DEQUEUE, END, NEVER, SEND
from bufgym.sim.transition import next_event
from bufgym.traces import Trace

kernels = pytest.mark.kernels


@kernels
@given(topic_cases(max_messages=40))
def test_agrees_with_reference_event_by_event(case):
    L = case.case.capacity

    def check(event, senders, reference):
        batch = senders.batch
        credit(batch, 0, int(batch.senders[0]["now_us"]))
        agree(senders, reference)
        view = python_view(jit.named(batch), 0)
        assert (view.window, view.in_flight) == (case.case.episode.window, len(reference.in_flight))
        assert (view.busy, view.left_bytes) == (int(bool(reference.socket)), reference.left_bytes())
        if event == "decision":
            agree_on_gaps(senders, reference)
        if event == "send":
            can = [reference.sendable(m) for m in reference.slots()]
            beyond = [False] * (L + 1 - len(can))
            assert [decisions.can_send(batch, 0, k) for k in range(-1, L + 1)] == [False, *can, *beyond]
            assert decisions.can_hold(batch, 0) == reference.may_hold()

    senders, reference = case.beside_its_reference(check)
    agree_on_log(senders, reference)
    until = int(senders.batch.senders[0]["now_us"]) + 5_000
    credit(senders.batch, 0, until)
    age_until(senders.batch, 0, until)
    for k in range(len(case.topics)):
        age_topic_until(senders.batch, 0, k, until)
    agree(senders, reference, until, to_the_end=True)


def agree(senders, reference, until=None, to_the_end=False):
    """The same is queued and in flight, nothing has been lost, and the sums are those from scratch."""
    batch = senders.batch
    sender = np.asarray(batch.senders)[0]
    until = reference.now if until is None else until
    slots = np.asarray(batch.slots[0])[sender["first"] : sender["first"] + sender["occupancy"]]
    assert sender["now_us"] == reference.now
    assert slots["seq"].tolist() == [m["seq"] for m in reference.slots()]
    assert sender["backlog_bytes"] == sum(m["bytes"] for m in reference.slots())
    assert sender["dequeued"] - sender["acked"] == len(reference.in_flight)
    assert sender["busy"] == len(reference.socket)
    assert (sender["rejected"], sender["evicted"], sender["invalid"]) == (
        reference.rejected,
        reference.evicted,
        reference.invalid,
    )
    assert sender["retained_gain"] == pytest.approx(reference.retained_gain(), abs=1e-9)
    assert sender["delivered_gain"] == pytest.approx(reference.delivered_gain(until), abs=1e-9)
    for slot, message in zip(slots, reference.slots(), strict=True):
        last = reference.kept_before(message)
        gain = reference.gain(reference.lane(message), [last, message]) if last else 0.0
        assert slot["gain"] == pytest.approx(gain, abs=1e-12)
    if reference.one_queue:
        return
    topics, aged = np.asarray(batch.topics[0]), reference.aged(until, to_the_end)
    assert (topics["weight"] * topics["aged"]).sum() == pytest.approx(aged, rel=1e-9, abs=1e-12)
    if to_the_end:  # all topics at once say the same as topic by topic
        assert sender["aged"] == pytest.approx(aged, rel=1e-9, abs=1e-9)
    heard = sum(rules.weight for k, rules in enumerate(reference.rules) if reference.received(k, until))
    assert sender["heard"] == pytest.approx(heard)
    assert sender["late"] == pytest.approx(reference.late(until))
    for k, row in enumerate(np.asarray(batch.topics[0])[: len(reference.rules)]):
        counted = reference.queues[k], reference.arrived[k], reference.sent[k], reference.received(k, until)
        assert [row[what] for what in ("queued", "arrived", "dequeued", "received")] == list(map(len, counted))
        for last in reference.sent[k][-1:]:
            sent = row["dequeued_arrival_us"], row["dequeued_x"], row["last_dequeue_us"]
            assert sent == (last["us"], last["x"], reference.dequeued[last["seq"]])


def agree_on_gaps(senders, reference):
    """What a policy reads about the newcomer and every slot."""
    seen = jit.named(senders.batch)
    buffer, arrival = python_view(seen, 0), seen.arrivals[0, seen.senders[0].next]
    newcomer, slots = reference.newcomer, reference.slots()
    zero, last = reference.reference(), reference.kept_before(newcomer)
    assert (buffer.dequeued_arrival_us, buffer.dequeued_x) == (zero["us"], zero["x"])
    gain = reference.gain(reference.lane(newcomer), [last, newcomer]) if last else 0.0
    assert arrival_gain(buffer, arrival) == pytest.approx(gain, abs=1e-12)
    assert decisions.has_room(senders.batch, 0) == reference.fits(newcomer)
    assert decisions.can_reject(senders.batch, 0) == (not reference.must_keep(newcomer))
    evictable = reference.evictable(newcomer)
    for k, message in enumerate([*slots, newcomer]):
        lane = reference.lane(message)
        (a_us, b_us), (a, b) = reference.gaps(message, "us"), reference.gaps(message, "x")
        assert gaps(buffer, arrival, True, k)[:2] == (a_us, b_us)
        assert motion_gaps(buffer, arrival, k) == (a, b)
        v = reference.rules[lane].v
        assert loss(buffer, arrival, k) == pytest.approx(
            reference.rules[lane].weight * (v(a) + v(b) - v(a + b)), abs=1e-12
        )
        own = [j for j, m in enumerate(slots) if reference.lane(m) == lane]
        assert before(buffer, k, lane) == max([j for j in own if j < k], default=-1)
        if k < len(slots):
            assert slot_after(buffer, k, lane) == min([j for j in own if j > k], default=len(slots))
            assert is_first(buffer, k) == (k == own[0])
            assert decisions.can_evict(senders.batch, 0, k) == (message in evictable)


def agree_on_log(senders, reference):
    assert {k for k, entry in enumerate(np.asarray(senders.batch.log[0])) if entry["limited"]} == reference.limited
    assert log(senders) == reference_log(reference)
    assert order(senders) == reference.order


@kernels
@given(topic_cases(max_messages=25))
def test_rollouts_agree_with_reference_compiled_and_not(case):
    reference, policy = case.run_reference(), case.policy(compile=True)
    senders, again = case.run(policy), case.senders()
    agree_on_log(senders, reference)
    agree(senders, reference, FOREVER)
    again.run(replace(policy, compile=False))
    for _ in range(2):
        assert same(senders, again)
        for name in ("aged", "late", "invalid"):
            assert senders.batch.senders[0][name] == again.batch.senders[0][name]
        assert (np.asarray(senders.batch.topics) == np.asarray(again.batch.topics)).all()
        again.load(0, case.case.episode)  # which forgets the run before
        again.run(policy)


@kernels
@given(topic_cases(max_messages=30), st.randoms(use_true_random=False))
def test_what_the_masks_allow_is_carried_out_and_invariants_hold(case, chance):
    senders = case.senders()
    batch, sender = senders.batch, senders.batch.senders[0]
    L, event, now_us = case.case.capacity, None, 0
    # Arrivals that ask nobody may find no room; where all ask, and are given what is possible, nothing is impossible.
    everyone = case.case.episode.first_decision == 0 and case.case.episode.last_decision > len(
        case.case.reference_messages
    )
    while event != END:
        event = next_event(batch, None, 0)
        assert sender["now_us"] >= now_us
        now_us = int(sender["now_us"])
        hold(case, senders)
        if event == DECISION:
            possible = [k for k in range(L) if decisions.can_evict(batch, 0, k)]
            possible += [REJECT] * decisions.can_reject(batch, 0) + [ACCEPT] * decisions.has_room(batch, 0)
            assert decisions.decide(batch, 0, chance.choice(possible))
        elif event == SEND:
            possible = [k for k in range(L) if decisions.can_send(batch, 0, k)] + [HOLD] * decisions.can_hold(batch, 0)
            assert decisions.answer_send(batch, 0, chance.choice(possible))
        elif event == DEQUEUE:
            decisions.answer_dequeue(batch, 0, chance.random() < 0.5)
    assert sender["invalid"] == 0 or not everyone
    assert sender["next"] == len(case.case.reference_messages)
    assert next_event(batch, None, 0) == END  # and stays there


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
    dropped, transmitted, dequeued = (rows[name] != NEVER for name in ("dropped_us", "transmitted_us", "dequeued_us"))
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


SCHEDULERS, ACKS_US = (None, head, holds_sometimes), st.sampled_from([0, 0, 1, 3_000])
PLAIN = [
    p
    for p in (*map(policies.get, policies.names()), ANYTHING)
    if p.privileged is None
    and not p.unbounded
    and not any(p.work)
    and not p.schedules
    and p.client == ClientSettings()
    and p.name != "target-gap"  # with topics it follows the smallest gap alone
]
"""Policies of one queue that know nothing beforehand, and one that decides at random."""


@kernels
@given(cases(max_messages=25), VALUES, st.sampled_from(SCHEDULERS), st.sampled_from(PLAIN), st.integers(1, 4), ACKS_US)
def test_one_topic_without_rules_is_a_plain_sender(case, v, on_send, policy, window, ack_delay_us):
    episode = replace(case.episode, window=window, ack_delay_us=ack_delay_us)
    arrivals = case.episode.arrivals.copy()
    arrivals["topic"] = 0
    limits = {"max_bytes": case.max_bytes, "decide_at": case.decide_at}
    scheduled = policy if on_send is None else replace(policy, on_send=on_send)
    plain = sim.run(policy if on_send is head else scheduled, [episode], case.capacity, v, **limits)
    only = [Topic("only")]
    topics = sim.run(scheduled, [replace(episode, arrivals=arrivals)], case.capacity, v, topics=only, **limits)
    assert same(plain, topics), policy.name


@kernels
@pytest.mark.parametrize("name", naive_schedulers.REFERENCES)
@given(topic_cases(min_topics=2, max_messages=30))
def test_schedulers_agree_with_their_references(name, case):
    policy = policies.get(name)
    case = replace(case, client=policy.client, schedules=True, drops_heads=False)
    reference, episode = case.reference(), case.case.episode
    if not policy.client.awaits_acks:  # then the socket takes the next message when the last has crossed
        reference.window, reference.ack_delay_us = 1, 0
    naive_schedulers.REFERENCES[name](reference)
    reference.run(case.case.reference_messages, episode.first_decision, episode.last_decision)
    senders = case.run(policy)
    assert log(senders) == reference_log(reference)
    assert order(senders) == reference.order
    assert senders.batch.senders["invalid"][0] == reference.invalid
    assert (
        reference.invalid == 0
        or episode.first_decision > 0
        or episode.last_decision < len(case.case.reference_messages)
    )
    assert same(senders, case.run(replace(policy, compile=False)))


@pytest.mark.parametrize("name", [name for name in policies.names() if policies.get(name).privileged is None])
@given(topic_cases(min_topics=2, max_messages=25))
def test_every_policy_runs_on_topics_and_nothing_is_lost(name, case):
    policy = policies.get(name)
    capacity = len(case.case.reference_messages) if policy.unbounded else case.case.capacity
    case = replace(case, client=policy.client, case=replace(case.case, capacity=capacity, max_bytes=None))
    senders = case.run(policy)
    hold(case, senders)
    assert senders.batch.senders["next"][0] == len(case.case.reference_messages)
    # No no_drop message goes while another that could go is queued.
    rows, arrivals = np.asarray(senders.batch.log[0]), case.case.episode.arrivals
    free = np.array([not topic.no_drop for topic in case.topics])[arrivals["topic"]]
    for lost in np.flatnonzero(~free & (rows["dropped_us"] != NEVER) & (rows["limited"] == 0)):
        at_us = arrivals["arrival_us"][lost]
        assert rows["dropped_us"][lost] == at_us  # rejected when it came: no_drop is never evicted
        later = [(rows[field] == NEVER) | (rows[field] > at_us) for field in ("dequeued_us", "dropped_us")]
        assert not (free & later[0] & later[1])[:lost].any()


@kernels
def test_a_step_reads_no_topic_that_has_had_no_message():
    """Rules that are no numbers would be in the reward, H and the observation, were they read."""
    streams = [Stream(Topic(name), hz, 40_000) for name, hz in (("a", 20.0), ("b", 10.0), ("silent", 0.1))]
    env = SenderEnv(Client(tuple(streams), (Trace.constant(1e6, 10),), duration_s=10.0), 4, observation="flat")
    _, info = env.reset(seed=4)
    arrivals, batch = env.sub_envs.senders.episodes[0].arrivals, env.sub_envs.senders.batch
    begins = int(np.flatnonzero(arrivals["topic"] == 2)[0])
    assert begins > 60
    for name in ("priority", "weight", "aged"):
        batch.topics[name][0, 2] = np.nan
    steps = 0
    while batch.senders["next"][0] < begins - 1:
        seen, reward, *_, info = env.step(int(np.flatnonzero(info["action_mask"])[-1]))
        assert np.isfinite([*seen, reward, info["qoi"], *info["reward_terms"].values()]).all()
        steps += 1
    assert steps > 60
