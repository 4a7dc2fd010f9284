"""The sender with topics: worked by hand, event by event against its twin, and what must hold whatever is decided."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from cases import VALUES, cases, log, order, same, trace
from hypothesis import given
from hypothesis import strategies as st
from topic_cases import choice, decision, topic_cases, unwanted

from bufgym import policies
from bufgym.errors import BufgymError
from bufgym.model import qoi
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
from bufgym.model.link import FOREVER, Link
from bufgym.model.topics import Topic, check_topics, check_window
from bufgym.policies.registry import ClientSettings
from bufgym.scenario import Episode, messages
from bufgym.sim import (
    DECISION,
    DEPARTURE,
    DEQUEUE,
    END,
    NEVER,
    SEND,
    Senders,
    age_until,
    answer_dequeue,
    answer_send,
    can_evict,
    can_hold,
    can_reject,
    can_send,
    credit,
    decide,
    has_room,
    named,
    next_event,
    python_view,
    run,
)

V = qoi.exponential(0.5)
MS = 1_000
NAMES = {DECISION: "decision", DEPARTURE: "departure", DEQUEUE: "dequeue", SEND: "send", END: "end"}


# --- by hand ---------------------------------------------------------------------------------------------------------


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


def test_two_in_flight_over_a_round_trip_of_100_ms():
    # 0 and 1 go at once: 0 crosses at 1 ms, 1 behind it at 2. Their pongs come at 101 and 102 ms and let 2 and 3 go;
    # 3 follows 2 on the link (102 to 103 ms). The pong of 2 comes at 202 ms and lets 4 go.
    senders = after_run(episode([0] * 5, window=2, ack_delay_us=100 * MS))
    assert log(senders) == {
        "dequeued_us": {0: 0, 1: 0, 2: 101 * MS, 3: 102 * MS, 4: 202 * MS},
        "transmitted_us": {0: 1 * MS, 1: 2 * MS, 2: 102 * MS, 3: 103 * MS, 4: 203 * MS},
        "dropped_us": {},
    }


def test_one_in_flight_leaves_the_link_idle():
    # Each message takes 1 ms and its pong another 50: one every 51 ms, on a link that could carry 51 meanwhile.
    senders = after_run(episode([0, 0, 0], window=1, ack_delay_us=50 * MS))
    assert log(senders)["dequeued_us"] == {0: 0, 1: 51 * MS, 2: 102 * MS}
    assert log(senders)["transmitted_us"] == {0: 1 * MS, 1: 52 * MS, 2: 103 * MS}
    # Without pongs to wait for, the window only counts what has not crossed yet.
    senders = after_run(episode([0, 0, 0], window=3))
    assert log(senders)["dequeued_us"] == {0: 0, 1: 0, 2: 0}
    assert log(senders)["transmitted_us"] == {0: 1 * MS, 1: 2 * MS, 2: 3 * MS}


def test_a_client_that_awaits_no_pongs():
    senders = after_run(episode([0, 0, 0], window=2, ack_delay_us=50 * MS), client=ClientSettings(awaits_acks=False))
    assert log(senders)["dequeued_us"] == {0: 0, 1: 1 * MS, 2: 2 * MS}


@pytest.mark.parametrize(("third_ms", "dropped"), [(51, {}), (50.999, {2: 50_999})])
def test_a_pong_comes_before_an_arrival_at_its_instant(third_ms, dropped):
    # L = 1: message 1 waits for the pong of 0, at 51 ms. What comes then finds room, a microsecond earlier it does not.
    senders = after_run(episode([0, 0, third_ms], window=1, ack_delay_us=50 * MS), capacity=1)
    assert log(senders)["dropped_us"] == dropped


def test_10_hz_of_a_30_hz_stream_is_every_third():
    camera = (Topic("camera", rate_limit_hz=10),)
    asked = []

    def note(buffer, arrival, memory):
        asked.append(int(arrival.seq))
        return ACCEPT

    # 0, 33.333, 66.667, 100, ... ms: those kept are exactly 1 / rate apart. Of the others nobody is asked.
    senders = after_run(episode([round(k * 1e6 / 30) / MS for k in range(10)]), camera, on_arrival=note)
    assert order(senders) == asked == [0, 3, 6, 9]
    assert log(senders)["dropped_us"].keys() == {1, 2, 4, 5, 7, 8}
    assert np.asarray(senders.batch.log[0])["limited"].tolist() == [0, 1, 1] * 3 + [0]
    # A microsecond too soon after the last one kept is too soon; what was dropped does not count.
    senders = after_run(episode([0, 99.999, 100, 199.999, 200.001]), camera)
    assert order(senders) == [0, 2, 4]
    # What the policy rejected was not kept either: 1 comes 1 ms later and is asked about.
    senders = after_run(episode([0, 1, 2]), camera, on_arrival=lambda b, a, m: REJECT if a.seq == 0 else ACCEPT)
    assert log(senders)["dropped_us"] == {0: 0, 2: 2 * MS}


@pytest.mark.parametrize(
    ("hooks", "invalid"), [({}, 0), ({"on_send": lambda b, m: 0}, 3), ({"on_send": lambda b, m: HOLD}, 1)]
)
def test_rate_limits_at_the_socket(hooks, invalid):
    # 10 Hz: 0 goes at once. At 1 and 60 ms nothing may go, at 120 ms it may: 1, the oldest. It crosses at 121 ms, which
    # is too soon for 2; no arrival or pong comes after that, so 2 and 3 stay.
    topics = (Topic("status", rate_limit_hz=10), Topic("other"))
    senders = after_run(episode([0, 1, 60, 120]), topics, client=ClientSettings(limit_at_send=True), **hooks)
    held_first = invalid == 1  # who always holds must let one go when nothing is to come, 0 at 120 ms; then nothing may
    assert log(senders)["dequeued_us"] == ({0: 120 * MS} if held_first else {0: 0, 1: 120 * MS})
    assert log(senders)["dropped_us"] == {}
    # Slot 0 is asked for in vain at 1, 60 and 121 ms. To hold is no mistake when nothing may go.
    assert senders.batch.senders[0]["invalid"] == invalid


def test_a_buffer_full_of_no_drop():
    # 1 byte crosses and no more: command 0 is in transmission, 1 and 2 fill the buffer. Camera 3 can't evict them,
    # whoever asks for it. Command 4 can't be kept either: it is lost, and shows as rejected.
    topics = (Topic("command", no_drop=True), Topic("camera", priority=20))
    blocked = {"knots": ((0, 0), (1, 1)), "after": "stop"}
    senders = after_run(
        episode([0] * 5, [0, 0, 0, 1, 0], **blocked),
        topics,
        capacity=2,
        on_arrival=lambda b, a, m: 0 if a.seq > 2 else ACCEPT,
    )
    assert log(senders)["dropped_us"] == {3: 0, 4: 0}
    assert (senders.batch.senders[0]["rejected"], senders.batch.senders[0]["invalid"]) == (2, 2)
    # With droppable messages in the buffer it drives out the oldest of the lowest priority, though "reject" is said:
    # 1 is camera, 2 and 3 status (priority 1), 4 the command.
    topics = (Topic("command", no_drop=True), Topic("camera", priority=20), Topic("status"))
    senders = after_run(
        episode([0] * 5, [0, 1, 2, 2, 0], **blocked),
        topics,
        capacity=3,
        on_arrival=lambda b, a, m: REJECT if a.seq == 4 else ACCEPT,
    )
    assert log(senders)["dropped_us"] == {2: 0}


@pytest.mark.parametrize("nonsense", [REJECT, -3, -4, 99])
def test_no_answer_drops_a_no_drop_message_that_has_room(nonsense):
    senders = after_run(episode([0]), (Topic("command", no_drop=True),), on_arrival=lambda b, a, m: nonsense)
    assert log(senders)["dropped_us"] == {}
    assert senders.batch.senders[0]["invalid"] == 1


def test_minus_three_is_no_decision():
    # Neither for a queue without topics: impossible, so what a queue does.
    senders = after_run(episode([0]), on_arrival=lambda b, a, m: -3)
    assert (order(senders), senders.batch.senders[0]["invalid"]) == ([0], 1)


def test_a_limit_of_one_topic():
    # At most one camera message waits, though the buffer has room; status is not concerned.
    topics = (Topic("camera", limit=1), Topic("status"))
    senders = after_run(episode([0, 0, 0, 0], [0, 0, 0, 1]), topics)
    assert log(senders)["dropped_us"] == {2: 0}
    # Slot 0 (status) is no help for a camera message, slot 1 (camera) is.
    topics = (Topic("camera", limit=1), Topic("status"))
    senders = Senders(1, 5, V, max_messages=4, topics=topics)
    senders.load(0, episode([0, 0, 0, 0], [1, 1, 0, 0]))
    while next_event(senders.batch, None, 0) != DECISION or senders.batch.senders[0]["next"] < 3:
        if senders.batch.senders[0]["waiting"]:
            decide(senders.batch, 0, ACCEPT)
    assert [can_evict(senders.batch, 0, k) for k in range(3)] == [False, True, False]
    assert not has_room(senders.batch, 0)


def test_a_topic_is_sent_in_order():
    # Slots while 0 is in transmission: 1 (a), 2 (b), 3 (a), 4 (b). Asked for slot 2 (3, not a's oldest): impossible,
    # the oldest goes. Then 2 (b) and 3 (a), 4 wait: slot 1 (3) goes first, then the rest.
    topics = (Topic("a"), Topic("b"))
    senders = after_run(episode([0] * 5, [0, 0, 1, 0, 1]), topics, on_send=scripted(0, 2, 1, 0, 0))
    assert order(senders) == [0, 1, 3, 2, 4]
    assert senders.batch.senders[0]["invalid"] == 1


def test_holding_until_the_next_arrival_or_pong():
    # 0 is held back at 0 ms; at 5 ms message 1 arrives, both wait, the scheduler holds again; nothing else is to come
    # after 7 ms, so that the third HOLD is impossible and 0 goes. At its crossing 1 goes, then 2.
    senders = after_run(episode([0, 5, 7]), on_send=scripted(HOLD, HOLD, HOLD, 0, 0))
    assert log(senders)["dequeued_us"] == {0: 7 * MS, 1: 8 * MS, 2: 9 * MS}
    assert senders.batch.senders[0]["invalid"] == 1
    # While a pong is to come, holding is possible: 1 is held back at 1 ms of its own accord until that of 0 at 11 ms.
    senders = after_run(episode([0, 0], window=2, ack_delay_us=10 * MS), on_send=scripted(0, HOLD, 0))
    assert log(senders)["dequeued_us"] == {0: 0, 1: 11 * MS}


def test_flushing_no_drop():
    # n_T = 1 and a pong 50 ms after. Commands 1 and 3 go though the window is full, one after the other; camera 2 waits
    # for the pongs of all three: they come at 51, 52 and 53 ms.
    topics = (Topic("command", no_drop=True), Topic("camera"))
    for hooks in ({}, {"on_send": lambda buffer, memory: 0}):
        senders = after_run(
            episode([0] * 4, [1, 0, 1, 0], window=1, ack_delay_us=50 * MS),
            topics,
            client=ClientSettings(flush_no_drop=True),
            **hooks,
        )
        assert log(senders)["dequeued_us"] == {0: 0, 1: 0, 3: 0, 2: 53 * MS}


def test_flushing_is_for_no_drop_alone():
    # A plain sender has no no_drop messages: its window holds.
    senders = after_run(episode([0] * 3, window=1, ack_delay_us=50 * MS), client=ClientSettings(flush_no_drop=True))
    assert log(senders)["dequeued_us"] == {0: 0, 1: 51 * MS, 2: 102 * MS}


def test_information_of_two_topics():
    # V = 1 - 0.5^d. Topic a (weight 2) has x = 0, 1, 3: 2 x (V(1) + V(2)) = 2 x 1.25. Topic b (weight its priority,
    # 0.5) has x = 2, 5: 0.5 x V(3) = 0.5 x 0.875. The first of each adds no V.
    topics = (Topic("a", weight=2), Topic("b", priority=0.5))
    senders = after_run(episode([0] * 5, [0, 0, 1, 0, 1], x=[0, 1, 2, 3, 5]), topics)
    assert senders.batch.senders[0]["delivered_gain"] == senders.batch.senders[0]["retained_gain"] == 2.9375
    # Without a's x = 1 the gap of x = 3 reaches back to 0: 2 x V(3).
    senders = after_run(
        episode([0] * 5, [0, 0, 1, 0, 1], x=[0, 1, 2, 3, 5]),
        topics,
        on_arrival=lambda b, a, m: 0 if a.seq == 4 else ACCEPT,
    )
    assert order(senders) == [0, 2, 3, 4]
    assert senders.batch.senders[0]["delivered_gain"] == senders.batch.senders[0]["retained_gain"] == 2 * 0.875 + 0.4375


def test_a_topic_with_a_value_of_its_own():
    topics = (Topic("a", value=qoi.saturating(4)), Topic("b"))
    senders = after_run(episode([0] * 4, [0, 0, 1, 1], x=[0, 1, 2, 4]), topics)
    assert senders.batch.senders[0]["delivered_gain"] == 0.25 + 0.75


def test_the_first_message_of_a_held_queue_is_evicted():
    # Message 0 was held back and goes: 1 (x = 3) is now the first of all and adds no V. So with topics and without.
    for topics in ((), (Topic("only"),)):
        senders = after_run(
            episode([0, 0, 0], x=[1, 3, 4]),
            topics,
            on_arrival=lambda b, a, m: 0 if a.seq == 2 else ACCEPT,
            on_send=scripted(HOLD, HOLD, 0, 0),
        )
        assert order(senders) == [1, 2]
        assert senders.batch.senders[0]["delivered_gain"] == senders.batch.senders[0]["retained_gain"] == 0.5


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


def test_gaps_of_a_topic_of_which_nothing_was_sent():
    # Neither the origin of time nor that of x counts: b's first message, its second, and a newcomer of a third topic.
    gaps = []

    def note(buffer, arrival, memory):
        if arrival.seq == 4:
            gaps.append([(*time_gaps(buffer, arrival, k), *motion_gaps(buffer, arrival, k)) for k in range(4)])
        return ACCEPT

    topics = (Topic("a"), Topic("b"), Topic("c"))
    for from_ms, from_x in ((0, 0), (70, 9)):
        played = episode(np.array([0, 0, 0, 0.25, 0.5]) + from_ms, [0, 1, 0, 1, 2], x=np.arange(5.0) + from_x)
        after_run(played, topics, on_arrival=note)
    # Slots: 1 (b), 2 (a), 3 (b), newcomer 4 (c). b: 250 us and 2 from 1 to 3, one more such step is expected after 3.
    # a: at the same time as 0 and 2 on in x; likewise.
    expected = [(0, 250, 0, 2), (0, 0, 2, 2), (250, 250, 2, 2), (0, 0, 0, 0)]
    assert gaps == [expected, expected]


def test_gaps_behind_a_message_that_was_held_back():
    # Nothing was sent before 0, which waits; 1 came 3 ms after it and was rejected, 2 comes 4 ms after that. The gap
    # before 0 is none, and not back from 1. So with topics and without.
    for topics in ((), (Topic("only"),)):
        gaps = []

        def note(buffer, arrival, memory, gaps=gaps):
            between = [time_gaps(buffer, arrival, k) for k in range(len(buffer.slots) + 1)]
            gaps.append((buffer.dequeued_arrival_us, buffer.dequeued_x, between))
            return REJECT if arrival.seq == 1 else ACCEPT

        after_run(episode([1, 4, 8], x=[5, 6, 7]), topics, on_arrival=note, on_send=scripted(HOLD, HOLD, HOLD, 0))
        assert gaps[2] == (1 * MS, 5, [(0, 7 * MS), (7 * MS, 4 * MS)])


# --- bad configuration -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given_", "complaint"),
    [
        ({"name": ""}, "topic '': a name must be a non-empty text"),
        ({"priority": -1}, "topic 'a': priority = -1: must be a number > 0"),
        ({"priority": 0}, "priority = 0: must be a number > 0"),
        ({"priority": None}, "priority = None: must be a number > 0"),
        ({"priority": True}, "priority = True: must be a number > 0"),
        ({"priority": float("inf")}, "priority = inf: must be a number > 0"),
        ({"priority": 10**400}, "must be a number > 0"),
        ({"rate_limit_hz": 0}, "rate_limit_hz = 0: must be a number > 0"),
        ({"rate_limit_hz": "10"}, "rate_limit_hz = '10': must be a number > 0"),
        ({"weight": float("nan")}, "weight = nan: must be a number >= 0"),
        ({"weight": -0.5}, "weight = -0.5: must be a number >= 0"),
        ({"deadline_s": 0}, "deadline_s = 0: must be a number > 0"),
        ({"deadline_s": 1e300}, "deadline_s = 1e\\+300: must be a number > 0"),
        ({"no_drop": 1}, "no_drop = 1: must be true or false"),
        ({"limit": 0}, "limit = 0: must be a whole number from 1"),
        ({"limit": 1.5}, "limit = 1.5: must be a whole number from 1"),
        ({"value": 0.618}, "value = 0.618: must be a V of bufgym.model.qoi"),
        ({"no_drop": True, "rate_limit_hz": 10}, "rate_limit_hz = 10: a no_drop topic can't have a rate limit"),
        ({"no_drop": True, "limit": 3}, "limit = 3: a no_drop topic can't have a limit"),
    ],
)
def test_bad_topic(given_, complaint):
    with pytest.raises(BufgymError, match=complaint) as caught:
        Topic(**{"name": "a", **given_})
    assert "\n" not in str(caught.value)


def test_bad_lists_of_topics():
    with pytest.raises(BufgymError, match="topic 'a': two topics have this name"):
        Senders(1, 2, V, max_messages=1, topics=[Topic("a"), Topic("b"), Topic("a")])
    with pytest.raises(BufgymError, match="'a' is not a bufgym"):
        check_topics(["a"])
    with pytest.raises(BufgymError, match="257 topics: must be at most 256"):
        check_topics([Topic(str(k)) for k in range(257)])


@pytest.mark.parametrize(
    ("topic", "complaint"),
    [([0, 2], "episode: unknown topic 2; the senders know 2, from 0 on"), ([0, -1], "episode: unknown topic -1")],
)
def test_an_episode_with_an_unknown_topic(topic, complaint):
    with pytest.raises(BufgymError, match=complaint):
        after_run(episode([0, 1], topic), (Topic("a"), Topic("b")))


def test_the_slowest_rate_limit():
    # Slower than any episode is long: the first message and no other.
    assert order(after_run(episode([0, 1, 10**9]), (Topic("a", rate_limit_hz=1e-300),))) == [0]


@pytest.mark.parametrize("window", [0, -1, 1.0, True, "2", None, 10**6 + 1])
def test_bad_window(window):
    with pytest.raises(BufgymError, match="n_T must be a whole number from 1"):
        check_window(window)
    with pytest.raises(BufgymError, match="n_T must be a whole number from 1"):
        after_run(episode([0], window=window))


@pytest.mark.parametrize("ack_delay_us", [-1, 0.5, True, None, 2**62])
def test_bad_pong(ack_delay_us):
    with pytest.raises(BufgymError, match=f"ack_delay_us = {ack_delay_us!r}: must be a whole number from 0 to"):
        after_run(episode([0], ack_delay_us=ack_delay_us))


# --- against the twin ------------------------------------------------------------------------------------------------


@given(topic_cases())
def test_agrees_with_twin_event_by_event(case):
    senders, twin = case.senders(), case.twin()
    batch, events, answer, expected = senders.batch, case.twin_events(twin), None, ""
    while expected != "end":
        expected, event = events.send(answer), next_event(batch, None, 0)
        assert NAMES[event] == expected
        credit(batch, 0, int(batch.senders[0]["now_us"]))
        agree(senders, twin)
        view = python_view(named(batch), 0)
        assert (view.window, view.in_flight) == (case.case.episode.window, len(twin.in_flight))
        assert (view.busy, view.left_bytes) == (int(bool(twin.socket)), twin.left_bytes())
        answer = None
        if expected == "decision":
            agree_on_gaps(senders, twin)
            answer = decision(twin.newcomer["uniform"], case.case.capacity)
            decide(batch, 0, answer)
        elif expected == "send":
            masks = [can_send(batch, 0, k) for k in range(-1, case.case.capacity + 1)]
            assert masks == [False, *(twin.sendable(m) for m in twin.slots())] + [False] * (
                len(masks) - 1 - view.slots.size
            )
            assert can_hold(batch, 0) == twin.may_hold()
            answer = choice(twin.now, len(twin.slots()), len(twin.dequeued), case.case.capacity)
            answer_send(batch, 0, answer)
        elif expected == "dequeue":
            answer = unwanted(twin.now, len(twin.slots()))
            answer_dequeue(batch, 0, answer)
    agree_on_fates(senders, twin)
    until = int(batch.senders[0]["now_us"]) + 5_000
    credit(batch, 0, until)
    for k in range(len(case.topics)):
        age_until(batch, 0, k, until)
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
    seen = named(senders.batch)
    buffer, arrival = python_view(seen, 0), seen.arrivals[0, seen.senders[0].next]
    newcomer, slots = twin.newcomer, twin.slots()
    reference, last = twin.reference(), twin.kept_before(newcomer)
    assert (buffer.dequeued_arrival_us, buffer.dequeued_x) == (reference["us"], reference["x"])
    gain = twin.gain(twin.lane(newcomer), [last, newcomer]) if last else 0.0
    assert arrival_gain(buffer, arrival) == pytest.approx(gain, abs=1e-12)
    assert has_room(senders.batch, 0) == twin.fits(newcomer)
    assert can_reject(senders.batch, 0) == (not twin.must_keep(newcomer))
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
            assert can_evict(senders.batch, 0, k) == (message in evictable)


def agree_on_fates(senders, twin):
    assert {k for k, f in enumerate(np.asarray(senders.batch.log[0])) if f["limited"]} == twin.limited
    assert log(senders) == {
        "dequeued_us": twin.dequeued,
        "transmitted_us": twin.transmitted,
        "dropped_us": twin.dropped,
    }
    assert order(senders) == twin.order


@given(topic_cases(max_messages=150), st.booleans())
def test_rollouts_agree_with_twin(case, compiled):
    answers = {
        "decision": lambda: decision(twin.newcomer["uniform"], case.case.capacity),
        "send": lambda: choice(twin.now, len(twin.slots()), len(twin.dequeued), case.case.capacity),
        "dequeue": lambda: unwanted(twin.now, len(twin.slots())),
    }
    twin, answer, event = case.twin(), None, ""
    events = case.twin_events(twin)
    while event != "end":
        event = events.send(answer)
        answer = answers[event]() if event in answers else None
    senders = case.senders()
    senders.run(case.policy(compile=compiled))
    agree_on_fates(senders, twin)
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


# --- whatever is decided ---------------------------------------------------------------------------------------------


@given(topic_cases(min_topics=1), st.randoms(use_true_random=False))
def test_invariants_after_every_event(case, chance):
    senders = case.senders()
    batch, sender = senders.batch, senders.batch.senders[0]
    capacity, event, now_us = case.case.capacity, None, 0
    # Arrivals that ask nobody may find no room; where all ask, and are given what is possible, nothing is impossible.
    everyone = case.case.episode.first_decision == 0 and case.case.episode.last_decision > len(case.case.twin_messages)
    while event != END:
        event = next_event(batch, None, 0)
        assert sender["now_us"] >= now_us
        now_us = int(sender["now_us"])
        hold(case, senders)
        if event == DECISION:
            possible = [k for k in range(capacity) if can_evict(batch, 0, k)]
            possible += [REJECT] * can_reject(batch, 0) + [ACCEPT] * has_room(batch, 0)
            kept_if_possible(case, senders, chance.choice(possible), possible=True)
        elif event == SEND:
            possible = [k for k in range(capacity) if can_send(batch, 0, k)] + [HOLD] * can_hold(batch, 0)
            assert answer_send(batch, 0, chance.choice(possible))
        elif event == DEQUEUE:
            answer_dequeue(batch, 0, chance.random() < 0.5)
        hold(case, senders)
    assert sender["invalid"] == 0 or not everyone
    assert sender["next"] == len(case.case.twin_messages)
    assert next_event(batch, None, 0) == END  # and stays there


@given(topic_cases(min_topics=1))
def test_invariants_under_impossible_decisions(case):
    senders = case.senders()
    batch, event = senders.batch, None
    while event != END:
        event = next_event(batch, None, 0)
        if event == DECISION:
            uniform = float(batch.arrivals[0, batch.senders[0]["next"]]["uniform"])
            kept_if_possible(case, senders, decision(uniform, case.case.capacity))
        elif event == SEND:
            sender = batch.senders[0]
            k = choice(int(sender["now_us"]), int(sender["occupancy"]), int(sender["dequeued"]), case.case.capacity)
            answer_send(batch, 0, k)
        elif event == DEQUEUE:
            answer_dequeue(batch, 0, True)
        hold(case, senders)


def kept_if_possible(case, senders, answer, possible=False):
    """No decision drops a no_drop message but a newcomer that no single droppable message makes room for."""
    batch = senders.batch
    sender = np.asarray(batch.senders)[0].copy()
    slots = np.asarray(batch.slots[0])[sender["first"] : sender["first"] + sender["occupancy"]].copy()
    seq = int(sender["next"])
    newcomer = np.asarray(batch.arrivals[0])[seq].copy()
    assert decide(batch, 0, answer) or not possible
    gone = np.asarray(batch.log[0])["dropped_us"] != NEVER
    assert not any(gone[m["seq"]] and case.topics[m["topic"]].no_drop for m in slots)
    if not (gone[seq] and case.topics[newcomer["topic"]].no_drop):
        return
    spare = (case.case.max_bytes or 2**62) - sender["backlog_bytes"] - newcomer["size_bytes"]
    assert len(slots) == case.case.capacity or spare < 0
    assert not any(spare + m["size_bytes"] >= 0 and not case.topics[m["topic"]].no_drop for m in slots)


def hold(case, senders):
    """arrived = delivered + in transmission + buffered + dropped in each topic; windows, limits and order are kept."""
    batch = senders.batch
    sender = np.asarray(batch.senders)[0]
    arrived, first, queued = int(sender["next"]), int(sender["first"]), int(sender["occupancy"])
    rows = np.asarray(batch.log[0])[:arrived]
    topic = np.asarray(case.case.episode.arrivals)["topic"]
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
        assert all(case.topics[k].no_drop for k in topic[in_flight])
    else:
        assert len(in_flight) <= case.case.episode.window
    assert (np.diff(slots["seq"]) > 0).all()
    gain = 0.0
    for k, rules in enumerate(case.topics):
        of = topic[:arrived] == k
        own = slots["topic"] == k
        assert of.sum() == (of & (dropped | dequeued)).sum() + own.sum() == batch.topics[0, k]["arrived"]
        assert own.sum() == batch.topics[0, k]["queued"] <= (rules.limit or case.case.capacity)
        sent = [seq for seq in batch.order[0, : sender["dequeued"]].tolist() if topic[seq] == k]
        kept = sent + slots["seq"][own].tolist()
        assert kept == sorted(kept)  # in order of arrival
        v = rules.value or case.v
        gain += rules.share * sum(v(x[b] - x[a]) for a, b in pairwise(kept))
    # What is retained is what everything kept would add if it were delivered.
    assert sender["retained_gain"] == pytest.approx(gain, abs=1e-9)


# --- one topic without rules is a plain sender -----------------------------------------------------------------------


def head(buffer, memory):
    """The scheduler of a first in, first out queue."""
    return 0


def anything(buffer, arrival, memory):
    return int(arrival.uniform * (buffer.capacity + 4)) - 2


def holds_sometimes(buffer, memory):
    return int(buffer.now_us % 3 > 0) - 1


PLAIN = [
    p
    for p in (*map(policies.get, policies.names()), policies.Policy("test-anything", anything, compile=True))
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
        plain = run(
            policy if on_send is not holds_sometimes else scheduled(policy, on_send),
            [case.episode],
            case.capacity,
            v,
            **limits,
        )
        if on_send is not None:
            policy = scheduled(policy, on_send)
        topics = run(policy, [one_topic(case)], case.capacity, v, topics=[Topic("only")], **limits)
        assert same(plain, topics), policy.name


def scheduled(policy, on_send):
    return replace(policy, on_send=on_send)


@given(cases(), VALUES, st.integers(1, 4), st.sampled_from([0, 1, 3_000]))
def test_one_topic_without_rules_has_the_same_window(case, v, window, ack_delay_us):
    for on_send in (head, holds_sometimes):
        policy = replace(PLAIN[-1], on_send=on_send)
        plain = run(policy, [replace(case.episode, window=window, ack_delay_us=ack_delay_us)], case.capacity, v)
        topics = run(
            policy,
            [replace(one_topic(case), window=window, ack_delay_us=ack_delay_us)],
            case.capacity,
            v,
            topics=[Topic("only")],
        )
        assert same(plain, topics)
