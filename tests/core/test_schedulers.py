"""Schedulers and Robofleet's rivals: each rule worked by hand."""

import naive_schedulers
import numpy as np
import pytest
from cases import log, order, trace

from bufgym import policies
from bufgym.ground import files
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.model.topics import Topic
from bufgym.policies import registry
from bufgym.scenario import Episode, messages
from bufgym.sim import run

pytestmark = pytest.mark.kernels
V = qoi.exponential(0.618)
MS = 1_000
NAMES = list(naive_schedulers.TWINS)
RIVALS = ["rosbridge", "ros-native"]
ALL = [name for name in policies.names() if policies.get(name).privileged is None]


def played(name, script, topics, *, capacity=8, blocked_ms=100, window=1, ack_ms=0, max_bytes=None):
    """``script``: "0 A, 10 B" and so on, ms and topic; 1000 bytes each, or as a third word says.

    Nothing crosses for ``blocked_ms``, then 1000 bytes a ms. So message 0, which the socket takes at once, leaves at
    ``blocked_ms`` + 1, and one a ms after it.
    """
    lines = [line.split() for line in script.split(",")]
    sizes = np.array([int(rest[0]) if rest else 1_000 for _, _, *rest in lines])
    arrivals = messages(np.array([int(float(line[0]) * MS) for line in lines]), sizes)
    arrivals["topic"] = ["ABCN".index(line[1]) for line in lines]
    knots = [(0, 0), (blocked_ms * MS, 0)] if blocked_ms else [(0, 0)]
    link = Link(trace([*knots, ((blocked_ms + 1_000) * MS, 1_000 * 1_000)], "hold"))
    episode = Episode(arrivals, link, window=window, ack_delay_us=ack_ms * MS)
    return run(policies.get(name), [episode], capacity, V, topics=topics, max_bytes=max_bytes)


def dropped(senders):
    """What was dropped, in that order."""
    return [seq for _, seq in sorted((us, seq) for seq, us in log(senders)["dropped_us"].items())]


def dequeued_ms(senders):
    return {seq: us / MS for seq, us in log(senders)["dequeued_us"].items()}


def topics(a=1.0, b=2.0, c=3.0, **more):
    """A, B, C with these priorities (or settings), and N, which may not be dropped."""
    rules = [given if isinstance(given, dict) else {"priority": given} for given in (a, b, c)]
    return [*(Topic(name, **given) for name, given in zip("ABC", rules, strict=True)), Topic("N", no_drop=True, **more)]


WEIGHTED = topics({"weight": 1.0}, {"weight": 1.0}, {"weight": 3.0})
WEIGHTLESS = topics({"weight": 0}, {"weight": 0}, {"weight": 0})
TIMED = topics(1.0, {"deadline_s": 0.05}, {"deadline_s": 0.02})


@pytest.mark.parametrize(
    ("name", "script", "rules", "sent"),
    [
        ("fifo", "0 A, 1 C, 2 B, 3 A, 4 C, 5 N", topics(), [0, 1, 2, 3, 4, 5]),
        # B and C are equal: first in, first out among them, before all of A.
        ("strict-priority", "0 A, 1 A, 2 C, 3 A, 4 B, 5 C", topics(1, 2, 2), [0, 2, 4, 5, 1, 3]),
        # At 101 ms: of A 0 was sent, which came at 0: age 101. B was never sent, its oldest came at 10: 91. C: 3 x 31 =
        # 93. So A's next, 2, which leaves no A. At 102: B 92, C 3 x 32 = 96. Then both of B.
        ("age-greedy", "0 A, 10 B, 20 A, 30 B, 70 C", WEIGHTED, [0, 2, 4, 1, 3]),
        # Due: 1 never, 2 at 60, 3 at 70, 4 at 55, 5 at 65. All are late when the link opens, and are sent all the same.
        ("edf", "0 A, 5 A, 10 B, 20 B, 35 C, 45 C", TIMED, [0, 4, 2, 5, 3, 1]),
        # At 101 ms A (sent at 0) and B (never) wait alike: A, then B. At 103 ms A waits since 101, B since 102,
        # whenever what now waits of them arrived.
        ("robofleet", "0 A, 10 B, 20 A, 102.5 B, 102.6 A", topics(1, 1), [0, 2, 1, 4, 3]),
        # Round again: A (101), B (102), N, then of A alone; neither priority nor no_drop count.
        ("ros-native", "0 A, 1 A, 2 A, 3 A, 4 N, 5 B, 6 B", topics(), [0, 1, 5, 4, 2, 6, 3]),
    ],
)
def test_what_goes_next(name, script, rules, sent):
    assert order(played(name, script, rules)) == sent


@pytest.mark.parametrize("name", ["fifo", "strict-priority", "age-greedy", "edf"])
def test_the_common_drop_rule(name):
    # L = 3. 4 is of B: B's oldest, 2, goes, though A ranks lower.
    assert dropped(played(name, "0 A, 1 A, 2 B, 3 C, 4 B", topics(), capacity=3)) == [2]
    # No C is queued: A, the lowest, loses its oldest, 1. Then no A is left: 5 is rejected, for B and C rank above it.
    assert dropped(played(name, "0 A, 1 A, 2 B, 3 B, 4 C, 5 A", topics(), capacity=3)) == [1, 5]
    # One of equal rank goes: 2, the oldest of B, for 4 of C.
    assert dropped(played(name, "0 A, 1 C, 2 B, 3 B, 4 A", topics(2, 2, 3), capacity=3)) == [2]
    # A limit is met by the topic alone, though there is room.
    assert dropped(played(name, "0 A, 1 B, 2 B, 3 A, 4 B", topics(1.0, {"limit": 2}))) == [1]


ROBOFLEET = "0 A, 10 B, 20 A, 30 B, 40 N, 50 N"
EACH_40_MS = "0 A, 40 A, 80 A, 120 A, 160 A, 200 A, 220 A"
WOKEN_BY_B = "0 A, 40 A, 80 A, 105 B, 120 A, 160 A, 205 A"
LIMITED = topics({"rate_limit_hz": 10.0})
OPEN = {"blocked_ms": 0}
PONGS = {**OPEN, "window": 2, "ack_ms": 50}
"""An open link, n_T = 2, pongs 50 ms after crossing."""


@pytest.mark.parametrize(
    ("name", "script", "rules", "settings", "lost", "sent_ms"),
    [
        # 3 overwrites 1. When the link is free, N's two go first, then at 103 ms A has 1 x 103 (sent at 0) and B, which
        # was never sent, 2 x 103: B.
        ("robofleet", ROBOFLEET, topics(1, 2), {}, [1], {0: 0, 4: 101, 5: 102, 3: 103, 2: 104}),
        # n_T = 1 holds N's first back while 0 is on its way, but at 101 ms both go at once. They are across at 103 ms;
        # then A goes, whose priority x wait is the smaller.
        ("robofleet-released", ROBOFLEET, topics(1, 2), {}, [1], {0: 0, 4: 101, 5: 101, 2: 103, 3: 104}),
        # 0 fills half of the window, and each arrival is a pass of its own: 1 goes, 2 finds two on their way and waits
        # for 0's pong at 51 ms, when 3 goes with it: no pass begins while the window is full.
        ("robofleet-released", "0 A, 1 N, 2 N, 3 N", topics(), PONGS, [], {0: 0, 1: 1, 2: 51, 3: 51}),
        # 10 Hz. At arrival: 40 and 80 come too soon after 0; then 160 and 200 after 120. Exactly 100 ms later is not
        # too soon: 220 is.
        ("robofleet", EACH_40_MS, LIMITED, OPEN, [1, 2, 4, 5], {0: 0, 3: 120, 6: 220}),
        # At the socket the latest waits for its time: 2 has overwritten 1, and at 105 something wakes the scheduler: 2
        # goes, whose priority x wait is 105 against 2 x 105. 3 came at 120, sooner than 205: it is overwritten.
        ("robofleet-released", WOKEN_BY_B, LIMITED, OPEN, [1, 4, 5], {0: 0, 2: 105, 3: 106, 6: 205}),
        # A publisher's queue of 2: 1 goes for 4. At 101 ms A was sent from at 0, and C never, which counts as 0 too: A,
        # the first topic; then C, then A again.
        ("ros-native", "0 A, 1 A, 2 A, 3 C, 4 A", topics({"limit": 2}), {}, [1], {0: 0, 2: 101, 3: 102, 4: 103}),
        # The link is free each ms. Who keeps to n_T = 1 waits for a pong 50 ms after each crossing; rivals do not.
        *((name, "0 A, 0 B, 0 C", topics(), PONGS | {"window": 1}, [], {0: 0, 1: 1, 2: 2}) for name in RIVALS),
        ("fifo", "0 A, 0 B, 0 C", topics(), PONGS | {"window": 1}, [], {0: 0, 1: 51, 2: 102}),
    ],
)
def test_when_it_goes_and_what_is_dropped(name, script, rules, settings, lost, sent_ms):
    senders = played(name, script, rules, **settings)
    assert (dropped(senders), dequeued_ms(senders)) == (lost, sent_ms)


def test_rosbridge_keeps_everything():
    senders = played("rosbridge", ", ".join(f"{k} {'ABCN'[k % 4]}" for k in range(20)), topics(), capacity=2)
    assert order(senders) == list(range(20))


def test_clients():
    def client(name):
        return policies.get(name).client

    assert [name for name in ALL if client(name).limit_at_send or client(name).flush_no_drop] == ["robofleet-released"]
    assert [name for name in ALL if not client(name).awaits_acks] == ["rosbridge", "ros-native"]
    assert {n: client(n).encoding for n in ALL if client(n).encoding} == {"rosbridge": "json", "ros-native": "ros"}
    assert [name for name in ALL if client(name).copies] == ["ros-native"]


def test_made_for_topics():
    trained = files.shipped("agents/topics", "agents/pretrained/topics", "*.safetensors")
    assert sorted(policies.names(for_topics=True)) == sorted([*NAMES, *trained])
    assert sorted([*policies.names(for_topics=True), *policies.names(for_topics=False)]) == sorted(policies.names())


def test_your_own_can_be_made_for_topics(monkeypatch):
    monkeypatch.setattr(registry, "_REGISTRY", dict(registry._REGISTRY))

    def last_in(buffer, memory):
        """The oldest of the topic whose message came last."""
        newest = buffer.slots[len(buffer.slots) - 1].topic
        return next(k for k, slot in enumerate(buffer.slots) if slot.topic == newest)

    policies.register("lifo", on_send=last_in, for_topics=True)(policies.get("fifo").on_arrival)
    assert "lifo" in policies.names(for_topics=True) and "lifo" not in policies.names(for_topics=False)
    assert policies.get("lifo").schedules and not policies.get("drop-oldest").schedules
    assert order(played("lifo", "0 A, 1 B, 2 A, 3 B", topics())) == [0, 1, 3, 2]
