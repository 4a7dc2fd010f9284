"""The sender: every event worked by hand. ``test_topics_twin`` and ``test_policy_twins`` hold it beside its twin."""

import numpy as np
import pytest
from cases import log, order, trace

from bufgym import policies
from bufgym.errors import BufgymError
from bufgym.model import qoi
from bufgym.model.buffer import ACCEPT
from bufgym.model.link import Link
from bufgym.scenario import Episode, messages
from bufgym.sim import DECISION, END, Senders, can_evict, decide, has_room, next_event, run
from bufgym.sim.metrics import outcome

pytestmark = pytest.mark.kernels
V = qoi.exponential(0.5)
MS = 1_000


def line(times_ms, *, capacity=2, after="loop", sizes=1_000, knots=((0, 0), (1_000 * MS, 1_000_000)), **limits):
    """A sender on a link of 1 MB/s, so that a message of 1000 bytes takes 1 ms."""
    arrivals = messages(np.array(times_ms, np.int64) * MS, np.asarray(sizes, np.int64))
    senders = Senders(1, capacity, V, max_messages=len(arrivals), **limits)
    senders.load(0, Episode(arrivals, Link(trace(list(knots), after))))
    return senders


def times(dequeued_ms, transmitted_ms, dropped_ms):
    """A log in ms."""
    made = {"dequeued_us": dequeued_ms, "transmitted_us": transmitted_ms, "dropped_us": dropped_ms}
    return {name: {seq: ms * MS for seq, ms in entries.items()} for name, entries in made.items()}


def test_order_of_things_at_an_arrival():
    # Message 0 crosses from 0 to 1 ms. At 1 ms exactly, message 1 arrives: message 0 leaves first, the socket is idle,
    # so message 1 is taken at once. Message 2 arrives at the same time and waits its turn.
    senders = line([0, 1, 1])
    senders.run(policies.get("drop-oldest"))
    assert log(senders) == times({0: 0, 1: 1, 2: 2}, {0: 1, 1: 2, 2: 3}, {})


@pytest.mark.parametrize(("third_us", "dropped"), [(1_000, {}), (999, {2: 999})])
def test_a_departure_makes_room_for_the_arrival_at_its_instant(third_us, dropped):
    # L = 1. At 1 ms the socket takes message 1, so message 2, which arrives then, finds room.
    episode = Episode(messages(np.array([0, 0, third_us]), 1_000), Link(trace([(0, 0), (1_000, 1_000)], "loop")))
    assert log(run(policies.get("drop-newest"), [episode], 1, V))["dropped_us"] == dropped


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
    told = outcome(senders, 0)
    assert (told.arrived, told.delivered, told.in_transmission, told.buffered, told.dropped) == (4, 2, 1, 1, 0)
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


def test_running_means_by_hand():
    # Arrivals at 0, 8, 10 and 10 ms. The first gap, 8 ms, is the period; then 8 + (2 - 8) / 8, 7.25 + (0 - 7.25) / 8.
    # Message 0 is dequeued before 1, then 1 before 2, and none before 3; each weighs a sixteenth in the service ratio.
    views = []

    def note(buffer, arrival, memory):
        views.append((buffer.period_us / MS, buffer.period_square / MS**2, buffer.service_ratio))
        return ACCEPT

    line([0, 8, 10, 10], sizes=[1_000, 8_000, 1, 1], capacity=3).run(policies.Policy("note", note))
    ratio = 1 / 16 + (1 - 1 / 16) / 16
    assert views == [
        (0, 0, 0),
        (8, 64, 1 / 16),
        (7.25, 64 + (4 - 64) / 8, ratio),
        (7.25 * 7 / 8, 56.5 * 7 / 8, ratio * 15 / 16),
    ]


def take_all(buffer, arrival, memory):
    """Accepts what fits and drops the oldest where nothing does."""
    return ACCEPT if len(buffer.slots) < buffer.capacity else 0


def every_second(buffer, memory):
    memory[0] += 1
    return memory[0] % 2 == 0


def stale(buffer, memory):
    """Drops what has waited for more than 2 ms."""
    return buffer.now_us - buffer.slots[0].arrival_us > 2_000


def all_of_them(buffer, memory):
    return True


def head_dropper(on_dequeue, compiled=True):
    return policies.Policy("test-head", take_all, on_dequeue=on_dequeue, memory={"heads": 0.0}, compile=compiled)


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize(
    ("drops", "times_ms", "sizes", "logged", "h"),
    [
        # 0 goes out at 0 ms, 1 is dropped at 1 ms and 2 goes out, 3 is dropped at 2 ms. H = 1 + V(2) + V(2)
        (every_second, [0, 0, 0, 0, 0], 1_000, times({0: 0, 2: 1, 4: 2}, {0: 1, 2: 2, 4: 3}, {1: 1, 3: 2}), 2.5),
        # Message 0 takes 5 ms. By then 1 and 2 have waited for 5 and 4 ms: both go, 3 (1 ms) is taken. Message 4 finds
        # an idle link at 10 ms. H = 1 + V(3) + V(1)
        (
            stale,
            [0, 0, 1, 4, 10],
            [5_000, 1_000, 1_000, 1_000, 1_000],
            times({0: 0, 3: 5, 4: 10}, {0: 5, 3: 6, 4: 11}, {1: 5, 2: 5}),
            2.375,
        ),
        # Nothing is ever sent: each message goes as it comes, and nothing is known.
        (all_of_them, [0, 0, 3], 1_000, times({}, {}, {0: 0, 1: 0, 2: 3}), 0.0),
    ],
)
def test_heads_that_are_dropped(compiled, drops, times_ms, sizes, logged, h):
    senders = line(times_ms, capacity=5, sizes=sizes)
    senders.run(head_dropper(drops, compiled))
    assert log(senders) == logged
    told, sender = outcome(senders, 0), senders.batch.senders[0]
    assert (told.qoi, told.dropped, told.invalid) == (h, len(logged["dropped_us"]), 0)
    assert (sender["evicted"], sender["retained_gain"]) == (told.dropped, max(0.0, h - 1))


def test_the_bytes_after_a_dropped_head_follow_without_a_pause():
    # 700 bytes a microsecond. Message 0 ends at byte 1000, which crosses in 1.43 us: at 2 us. Then 1 is dropped;
    # 2 follows at byte 1000, not at the 1400 of 2 us: its last byte, 2000, crosses at 3 us and not at 4.
    # Where nothing follows, the link rests, and the next message begins when it arrives: 2 at 2 us, byte 1400.
    fast = Link(trace([(0, 0), (10, 7_000)], "loop"))
    for third_us, crossed_us in ((0, 3), (2, 4)):
        episode = Episode(messages(np.array([0, 0, third_us]), 1_000), fast)
        senders = run(head_dropper(every_second), [episode], 5, V)
        assert log(senders)["transmitted_us"] == {0: 2, 2: crossed_us}
        assert log(senders)["dropped_us"] == {1: 2}


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


LINKS = [
    Link(trace([(0, 0), (5_000, 4_000), (9_000, 4_000)], "loop"), 1_000),
    Link(trace([(0, 0), (2_000, 0), (3_000, 3_000)], "hold")),
]


def test_rows_of_a_batch_do_not_meet():
    episodes = [Episode(messages(np.arange(15) * (3 + k) * 100, 900 + k), LINKS[k % 2]) for k in range(4)]
    together = run(policies.get("afr"), episodes, 4, V)
    for k, episode in enumerate(episodes):
        alone = run(policies.get("afr"), [episode], 4, V)
        assert log(alone) == log(together, k)
        assert order(alone) == order(together, k)


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
