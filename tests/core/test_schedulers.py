"""Schedulers and Robofleet's rivals: what goes next by hand, and their clients. (All else: ``test_topics_twin``.)"""

import naive_schedulers
import numpy as np
import pytest
from cases import order, trace

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
ALL = [name for name in policies.names() if policies.get(name).privileged is None]


def played(name, script, topics, *, capacity=8):
    """``script``: "0 A, 10 B" and so on, ms and topic; 1000 bytes each.

    Nothing crosses for 100 ms, then 1000 bytes a ms. So message 0, which the socket takes at once, leaves at 101 ms,
    and one a ms after it.
    """
    lines = [line.split() for line in script.split(",")]
    arrivals = messages(np.array([int(float(ms) * MS) for ms, _ in lines]), 1_000)
    arrivals["topic"] = ["ABCN".index(topic) for _, topic in lines]
    link = Link(trace([(0, 0), (100 * MS, 0), (1_100 * MS, 1_000 * 1_000)], "hold"))
    return run(policies.get(name), [Episode(arrivals, link)], capacity, V, topics=topics)


def topics(a=1.0, b=2.0, c=3.0, **more):
    """A, B, C with these priorities (or settings), and N, which may not be dropped."""
    rules = [given if isinstance(given, dict) else {"priority": given} for given in (a, b, c)]
    return [*(Topic(name, **given) for name, given in zip("ABC", rules, strict=True)), Topic("N", no_drop=True, **more)]


WEIGHTED = topics({"weight": 1.0}, {"weight": 1.0}, {"weight": 3.0})
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
