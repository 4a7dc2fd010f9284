"""The sender: every event worked by hand once, then against the event-by-event twin, with nothing lost on the way."""

from __future__ import annotations

from dataclasses import replace

import naive
import numpy as np
import pytest
from cases import ANYTHING, VALUES, Case, cases, decide_anything, log, order, same, trace, twin_log
from hypothesis import given
from hypothesis import strategies as st

from bufgym import policies
from bufgym.errors import BufgymError
from bufgym.model import qoi
from bufgym.model.buffer import ACCEPT
from bufgym.model.link import Link
from bufgym.scenario import Episode, messages
from bufgym.sim import DECISION, END, Senders, can_evict, decide, has_room, next_event, run
from bufgym.sim.metrics import outcome

V = qoi.exponential(0.5)
MS = 1_000


POLICIES = {
    p.name: p
    for p in (*map(policies.get, policies.names()), ANYTHING)
    if p.privileged is None and not any(p.work) and p.name != "target-gap"
}
"""All but the learned ones and ``target-gap``, whose twins are in ``test_learned`` and ``test_target_gap``."""


def line(times_ms, *, capacity=2, after="loop", sizes=1_000, knots=((0, 0), (1_000 * MS, 1_000_000)), **limits):
    """A sender on a link of 1 MB/s, so that a message of 1000 bytes takes 1 ms."""
    arrivals = messages(np.array(times_ms, np.int64) * MS, np.asarray(sizes, np.int64))
    senders = Senders(1, capacity, V, max_messages=len(arrivals), **limits)
    senders.load(0, Episode(arrivals, Link(trace(list(knots), after))))
    return senders


def test_order_of_things_at_an_arrival():
    # Message 0 crosses from 0 to 1 ms. At 1 ms exactly, message 1 arrives: message 0 leaves first, the socket is idle,
    # so message 1 is taken at once. Message 2 arrives at the same time and waits its turn.
    senders = line([0, 1, 1])
    senders.run(policies.get("drop-oldest"))
    assert log(senders) == {
        "dequeued_us": {0: 0, 1: 1 * MS, 2: 2 * MS},
        "transmitted_us": {0: 1 * MS, 1: 2 * MS, 2: 3 * MS},
        "dropped_us": {},
    }


def test_a_departure_makes_room_for_the_arrival_at_its_instant():
    # L = 1. At 1 ms the socket takes message 1, so message 2, which arrives then, finds room: nothing is dropped.
    senders = line([0, 0, 1], capacity=1)
    senders.run(policies.get("drop-newest"))
    assert log(senders)["dropped_us"] == {}
    # Half a millisecond earlier it does not.
    arrivals = messages(np.array([0, 0, 999]), 1_000)
    senders = run(policies.get("drop-newest"), [Episode(arrivals, Link(trace([(0, 0), (1_000, 1_000)], "loop")))], 1, V)
    assert log(senders)["dropped_us"] == {2: 999}


def test_the_message_in_transmission_cannot_be_dropped():
    # All arrive at once: 0 goes out, 1 and 2 fill the queue, then 3 evicts 1 and 4 evicts 2.
    senders = line([0, 0, 0, 0, 0])
    senders.run(policies.get("drop-oldest"))
    assert order(senders) == [0, 3, 4]
    assert log(senders)["dropped_us"] == {1: 0, 2: 0}
    # H = 1 + V(3) + V(1) = 1 + 7/8 + 1/2
    assert outcome(senders, 0).qoi == 2.375


def test_a_link_that_stops_keeps_what_it_has():
    # 2500 bytes, then nothing ever: message 2 stays in transmission, message 3 in the buffer.
    senders = line([0, 0, 0, 1], knots=((0, 0), (2_500, 2_500)), after="stop")
    senders.run(policies.get("drop-oldest"))
    result = outcome(senders, 0)
    assert (result.arrived, result.delivered, result.in_transmission, result.buffered, result.dropped) == (
        4,
        2,
        1,
        1,
        0,
    )
    assert log(senders)["dequeued_us"] == {0: 0, 1: 1 * MS, 2: 2 * MS}


def test_start_offset():
    # The link rests for 5 ms; starting 3 ms into the trace, the first message waits 2 ms and crosses in 1.
    arrivals = messages(np.array([0]), 1_000)
    link = Link(trace([(0, 0), (5 * MS, 0), (10 * MS, 5_000)], "hold"), offset_us=3 * MS, propagation_us=7)
    senders = run(policies.get("drop-oldest"), [Episode(arrivals, link)], 1, V)
    assert log(senders)["transmitted_us"] == {0: 3 * MS}


def test_bytes_limit():
    # B = 2500: message 0 is in transmission, outside the buffer. 1 and 2 (1000 each) fit; 3 (1000) does not, though
    # L = 5: the oldest goes. 4 (3000) cannot fit whatever goes: it is dropped unasked.
    senders = line([0, 0, 0, 0, 0], capacity=5, sizes=[1_000, 1_000, 1_000, 1_000, 3_000], max_bytes=2_500)
    asked = []
    while (event := next_event(senders.batch, None, 0)) != END:
        if event == DECISION:
            seq, room = int(senders.batch.senders[0]["next"]), has_room(senders.batch, 0)
            asked.append((seq, room, [k for k in range(5) if can_evict(senders.batch, 0, k)]))
            decide(senders.batch, 0, ACCEPT if room else 0)
    # (arrival, is there room, which slots may go)
    assert asked == [(0, True, []), (1, True, []), (2, True, [0]), (3, False, [0, 1])]
    assert order(senders) == [0, 2, 3]
    assert outcome(senders, 0).invalid == 0


@pytest.mark.parametrize(("decide_at", "asked"), [("arrival", [0, 1, 2, 3, 4]), ("overflow", [3, 4])])
def test_decide_at(decide_at, asked):
    seen = []

    def note(buffer, arrival, memory):
        seen.append(int(arrival.seq))
        return ACCEPT if len(buffer.slots) < buffer.capacity else 0

    line([0, 0, 0, 0, 0], decide_at=decide_at).run(policies.Policy("note", note))
    assert seen == asked


def test_what_the_policy_sees():
    views = []

    def note(buffer, arrival, memory):
        views.append(buffer._replace(slots=buffer.slots["seq"].tolist()))
        return ACCEPT

    line([0, 0, 4, 4], sizes=[8_000, 500, 700, 1], capacity=3).run(policies.Policy("note", note))
    last = views[3]
    assert last.slots == [1, 2]
    assert (last.capacity, last.backlog_bytes, last.dequeued, last.dequeued_x, last.busy) == (3, 1_200, 1, 0.0, 1)
    # Message 0 has had 4 of its 8 ms; the arrival before this one came at 4 ms with x = 2.
    assert (last.left_bytes, last.left_fraction, last.stalled_us) == (4_000, 0.5, 4 * MS)
    assert (last.previous_us, last.previous_x, last.departures) == (4 * MS, 2.0, 0)
    assert (views[0].busy, views[0].left_bytes, views[1].departures) == (0, 0, 1)


# --- dropping at the head --------------------------------------------------------------------------------------------


def take_all(buffer, arrival, memory):
    """Accepts what fits and drops the oldest where nothing does."""
    return ACCEPT if len(buffer.slots) < buffer.capacity else 0


def every_second(buffer, memory):
    memory[0] += 1
    return memory[0] % 2 == 0


def stale(buffer, memory):
    """Drops what has waited for more than 2 ms."""
    return buffer.now_us - buffer.slots[0].arrival_us > 2_000


def unlucky(buffer, memory):
    return buffer.slots[0].uniform < 0.4


def head_dropper(on_dequeue, on_arrival=take_all, compiled=True):
    return policies.Policy("test-head", on_arrival, on_dequeue=on_dequeue, memory={"heads": 0.0}, compile=compiled)


COMPILED_OR_NOT = pytest.mark.parametrize("compiled", [True, False])


@COMPILED_OR_NOT
def test_every_second_head_is_dropped(compiled):
    # The heads are asked about in turn: 0 goes out at 0 ms, 1 is dropped at 1 ms and 2 goes out, 3 is dropped at 2 ms.
    senders = line([0, 0, 0, 0, 0], capacity=5)
    senders.run(head_dropper(every_second, compiled=compiled))
    assert log(senders) == {
        "dequeued_us": {0: 0, 2: 1 * MS, 4: 2 * MS},
        "transmitted_us": {0: 1 * MS, 2: 2 * MS, 4: 3 * MS},
        "dropped_us": {1: 1 * MS, 3: 2 * MS},
    }
    result = outcome(senders, 0)
    # H = 1 + V(2) + V(2)
    assert (result.qoi, result.dropped, result.delivered, result.invalid) == (2.5, 2, 3, 0)
    assert (senders.batch.senders[0]["evicted"], senders.batch.senders[0]["retained_gain"]) == (2, 1.5)


@COMPILED_OR_NOT
def test_a_link_without_heads_goes_idle(compiled):
    # Message 0 takes 5 ms. By then 1 and 2 have waited for 5 and 4 ms: both go, 3 (1 ms) is taken. Message 4 finds an
    # idle link at 10 ms. (x is the frame index: H = 1 + V(3) + V(1).)
    senders = line([0, 0, 1, 4, 10], capacity=5, sizes=[5_000, 1_000, 1_000, 1_000, 1_000])
    senders.run(head_dropper(stale, compiled=compiled))
    assert log(senders) == {
        "dequeued_us": {0: 0, 3: 5 * MS, 4: 10 * MS},
        "transmitted_us": {0: 5 * MS, 3: 6 * MS, 4: 11 * MS},
        "dropped_us": {1: 5 * MS, 2: 5 * MS},
    }
    assert outcome(senders, 0).qoi == 2.375


@COMPILED_OR_NOT
def test_the_bytes_after_a_dropped_head_follow_without_a_pause(compiled):
    # 700 bytes a microsecond. Message 0 ends at byte 1000, which crosses in 1.43 us: at 2 us. Then 1 is dropped;
    # 2 follows at byte 1000, not at the 1400 of 2 us: its last byte, 2000, crosses at 3 us and not at 4.
    fast = Link(trace([(0, 0), (10, 7_000)], "loop"))
    episode = Episode(messages(np.array([0, 0, 0]), 1_000), fast)
    senders = run(head_dropper(every_second, compiled=compiled), [episode], 5, V)
    assert log(senders)["transmitted_us"] == {0: 2, 2: 3}
    # Where nothing follows, the link rests, and the next message begins when it arrives: 2 at 2 us, byte 1400.
    episode = Episode(messages(np.array([0, 0, 2]), 1_000), fast)
    senders = run(head_dropper(every_second, compiled=compiled), [episode], 5, V)
    assert log(senders) == {"dequeued_us": {0: 0, 2: 2}, "transmitted_us": {0: 2, 2: 4}, "dropped_us": {1: 2}}


@COMPILED_OR_NOT
def test_every_head_is_dropped(compiled):
    # Nothing is ever sent: each message goes as it comes, and nothing is known.
    senders = line([0, 0, 3], capacity=1)
    senders.run(head_dropper(lambda buffer, memory: True, compiled=compiled))
    assert log(senders) == {"dequeued_us": {}, "transmitted_us": {}, "dropped_us": {0: 0, 1: 0, 2: 3 * MS}}
    assert (outcome(senders, 0).qoi, senders.batch.senders[0]["retained_gain"]) == (0.0, 0.0)


def test_what_the_policy_sees_at_the_head():
    seen = []

    def note(buffer, memory):
        seen.append((buffer.now_us, buffer.slots["seq"].tolist(), buffer.busy, buffer.left_bytes, buffer.dequeued))
        return bool(buffer.slots[0].seq == 1)

    line([0, 0, 0], capacity=5).run(head_dropper(note, compiled=False))
    assert seen == [(0, [0], 0, 0, 0), (1 * MS, [1, 2], 0, 0, 1), (1 * MS, [2], 0, 0, 1)]


def test_peak_backlog():
    # 0 is in transmission. 1 and 2 wait: 5000 bytes, the most of all, as 3 (500) takes the place of 1 (2000).
    senders = line([0, 0, 0, 0], sizes=[1_000, 2_000, 3_000, 500])
    senders.run(policies.get("drop-oldest"))
    assert outcome(senders, 0).peak_backlog_bytes == 5_000
    # At 1 ms 1 is dropped at the head and 2 is taken. So 3, which comes at 2 ms, waits alone: no more than 5000 yet.
    senders = line([0, 0, 0, 2], sizes=[1_000, 2_000, 3_000, 4_000])
    senders.run(head_dropper(every_second))
    assert outcome(senders, 0).peak_backlog_bytes == 5_000
    assert senders.batch.senders[0]["backlog_bytes"] == 0


HEAD_DROPPERS = st.sampled_from([every_second, stale, unlucky]).map(lambda drop: head_dropper(drop, decide_anything))


@given(cases(), VALUES, HEAD_DROPPERS)
def test_head_droppers_run_the_same_compiled_or_not(case, v, policy):
    assert same(case.run(policy, v), case.run(replace(policy, compile=False), v))


@given(cases(), HEAD_DROPPERS)
def test_what_is_dropped_at_the_head_might_never_have_come(case, policy):
    # The link serves the rest as if the dropped messages had been rejected at once.
    ours = log(case.run(policy, V))

    class Reject(naive.Policy):
        def decide(self, queue, newcomer, L, last_dequeued, previous):
            return naive.REJECT if newcomer["seq"] in ours["dropped_us"] else naive.ACCEPT

    everyone_asks = replace(case.episode, first_decision=0, last_decision=2**31)
    twin = replace(case, episode=everyone_asks, decide_at="arrival").run_twin(Reject())
    assert (ours["dequeued_us"], ours["transmitted_us"]) == (twin.dequeued, twin.transmitted)
    assert ours["dropped_us"].keys() == twin.dropped.keys()


# --- against the twin ------------------------------------------------------------------------------------------------


def agree(case: Case, name: str, v: qoi.Value) -> None:
    """The kernel and the twin made the same run."""
    ours, twin = case.run(POLICIES[name], v), case.run_twin(naive.policy(name, v))
    assert log(ours) == twin_log(twin)
    assert order(ours) == twin.order
    sender, result = ours.batch.senders[0], outcome(ours, 0)
    assert (sender["rejected"], sender["evicted"]) == (twin.rejected, twin.evicted)
    assert (sender["dequeued"], sender["transmitted"]) == (len(twin.dequeued), len(twin.transmitted))
    assert sender["backlog_bytes"] == sum(m["bytes"] for m in twin.queue)
    assert result.invalid == twin.invalid
    assert (result.arrived, result.delivered) == (len(case.twin_messages), len(twin.order))
    assert (result.dropped, result.in_transmission) == (len(twin.dropped), int(twin.sending is not None))
    assert result.buffered == len(twin.queue)
    x = [case.twin_messages[k]["x"] for k in twin.order]
    assert result.qoi == naive.information(v, x)
    # What was credited message by message is H; what is kept or sent is H of all of it.
    assert (sender["delivered_gain"] + 1 if x else 0) == pytest.approx(result.qoi, abs=1e-12)
    kept = x + [m["x"] for m in ([twin.sending] if twin.sending else []) + twin.queue]
    assert (sender["retained_gain"] + 1 if kept else 0) == pytest.approx(naive.information(v, kept), abs=1e-9)


@given(cases(), VALUES)
def test_agrees_with_twin_under_every_policy(case, v):
    for name in POLICIES:
        agree(case, name, v)


@given(cases(max_messages=120), VALUES)
def test_agrees_with_twin_on_any_decisions(case, v):
    agree(case, "test-anything", v)


def test_rows_of_a_batch_do_not_meet():
    episodes = [Episode(messages(np.arange(40) * (3 + k) * 100, 900 + k), LINKS[k % 2]) for k in range(6)]
    together = run(policies.get("afr"), episodes, 4, V)
    for k, episode in enumerate(episodes):
        alone = run(policies.get("afr"), [episode], 4, V)
        assert log(alone) == log(together, k)
        assert order(alone) == order(together, k)


LINKS = [
    Link(trace([(0, 0), (5_000, 4_000), (9_000, 4_000)], "loop"), 1_000),
    Link(trace([(0, 0), (2_000, 0), (3_000, 3_000)], "hold")),
]


def test_loading_again_forgets_the_last_episode():
    long = Episode(messages(np.arange(30) * 300, 800), LINKS[0])
    short = Episode(messages(np.arange(7) * 200, 500), LINKS[1])
    senders = Senders(1, 3, V, max_messages=30)
    senders.load(0, long)
    senders.run(policies.get("min-gap"))
    senders.load(0, short)
    senders.run(policies.get("min-gap"))
    assert log(senders) == log(run(policies.get("min-gap"), [short], 3, V))


@pytest.mark.parametrize(
    ("given_", "rule"),
    [
        ({"capacity": 0}, "capacity = 0: L must be a whole number from 1"),
        ({"capacity": 2.0}, "capacity = 2.0"),
        ({"capacity": True}, "capacity = True"),
        ({"max_bytes": 0}, "max_bytes = 0: B must be"),
        ({"decide_at": "departure"}, "decide_at = 'departure': must be 'arrival' or 'overflow'"),
    ],
)
def test_errors(given_, rule):
    with pytest.raises(BufgymError, match=rule):
        Senders(1, **{"capacity": 2, "v": V, "max_messages": 3, **given_})


def test_no_episode():
    with pytest.raises(BufgymError, match="no episode to run"):
        run(policies.get("afr"), [], 2, V)
