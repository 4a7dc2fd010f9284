"""The live queue, by hand and against the simulator: its log, replayed, makes the same decisions bit for bit."""

import gc
import math
import weakref
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from live_cases import Bench
from refusal_cases import refuse

from bufgym import policies
from bufgym.model.topics import Topic
from bufgym.policies.registry import Policy
from bufgym_robot import PolicyQueue, replay

PLAYABLE = [name for name in policies.names() if policies.get(name).ranked]
ONE_QUEUE = [name for name in policies.names(for_topics=False) if policies.get(name).ranked]


def test_drop_oldest_by_hand() -> None:
    """L = 2: the first goes to the socket at once, 1 and 2 wait, 3 evicts 1, and once the socket is free 2 follows."""
    bench = Bench("drop-oldest", 2)
    for k in range(4):
        assert bench.put(1000 * (k + 1)) == k
    item = bench.take()
    assert (item.seq, item.number, item.x, item.message) == (0, 0, 0.0, "message at 1000")
    assert bench.take() is None and len(bench.queue) == 2 and bench.queue.in_flight == 1
    assert [record["why"] for record in bench.events("dropped")] == ["evicted for 3"]
    assert bench.gone(5000).seq == 2
    assert bench.gone(6000).seq == 3
    assert bench.gone(7000) is None
    bench.queue.close()
    assert bench.queue.get() is None
    refuse("closed", bench.put, 8000)
    played = replay(bench.records)
    assert played.differences == ()
    assert played.outcome.delivered == 3 and played.outcome.dropped == 1
    assert played.senders.batch.log["transmitted_us"][0].tolist() == [5000, -1, 6000, 7000]


def test_the_policy_sees_how_much_of_the_message_in_transmission_is_left() -> None:
    seen: list[Any] = []
    remaining: list[int] = []

    def watches(buffer: Any, arrival: Any, memory: Any) -> int:
        "Accept while there is room."
        seen.append((buffer.busy, buffer.left_bytes, buffer.now_us, buffer.dequeued))
        remaining.append(buffer.remaining_us)
        return policies.ACCEPT if len(buffer.slots) < buffer.capacity else policies.REJECT

    bench = Bench(policy := Policy("watches", watches), 2, window=2, duration_s=35e-6)
    for at_us, left in ((10, 0), (20, 700), (30, 1700), (40, 1650), (50, -5)):
        bench.left = left
        bench.put(at_us)
        bench.take()
    # 0 goes at once; then 700 of it are left, then with 1 in the socket 700 + 1000; its last byte is left until gone.
    assert seen == [(0, 0, 10, 0), (1, 700, 20, 1), (1, 1700, 30, 2), (1, 1650, 40, 2), (1, 1001, 50, 2)]
    bench.gone(60)
    assert remaining == [25, 15, 5, 0, 0]
    assert replay(bench.records, policy).differences == ()
    assert remaining == [25, 15, 5, 0, 0] * 2


@pytest.mark.parametrize("name", PLAYABLE)
@given(data=st.data())
def test_a_log_replayed_makes_the_same_decisions(name: str, data: st.DataObject) -> None:
    """Whatever the clock does (it may step back), the sizes, the progress and the order of calls; also where the
    row has to forget settled messages again and again (room 8)."""
    draw = data.draw
    many = name not in ONE_QUEUE
    topics = (Topic("map", 2.0, rate_limit_hz=2.0), Topic("pose", 5.0, no_drop=True), Topic("image", 1.0, limit=2))
    bench = Bench(
        name,
        draw(st.integers(1, 5)),
        topics=topics if many else (),
        window=draw(st.integers(1, 3)),
        room=draw(st.sampled_from([8, 1024])),
        decide_at=draw(st.sampled_from(["arrival", "overflow"])),
        max_bytes=draw(st.sampled_from([None, 4000])),
        duration_s=draw(st.sampled_from([None, 0.5])),
    )
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    calls, slow = draw(st.integers(1, 40)), draw(st.floats(0.0, 0.9))
    at_us, x, away = 2, 0.0, 0
    for _ in range(calls):
        at_us = max(0, at_us + int(rng.choice([-30_000, 0, 1, 40_000, 300_000])))
        if rng.random() < slow or not away:
            x += float(rng.choice([0.0, 0.1, 1.0]))
            bench.left = int(rng.integers(-10, 6000))
            bench.put(at_us, int(rng.integers(1, 3000)), x=x, topic=int(rng.integers(3)) if many else 0)
        else:
            bench.us = at_us
            bench.queue.gone()
            away -= 1
        while bench.take() is not None:
            away += 1
    played = replay(bench.records)
    assert played.differences == ()
    if not many:
        assert (played.outcome.dropped, played.outcome.buffered) == (bench.queue.dropped, len(bench.queue))


@pytest.mark.parametrize("name", ["afr", "min-motion-gap"])
def test_hours_leave_no_trace_in_memory(name: str) -> None:
    """2,000 messages through a row of 64 columns: decisions as in one run, messages let go of, arrays as they were."""

    class Frame:
        """Something that can be watched."""

    bench = Bench(name, 4, room=64)
    alive = weakref.WeakSet[Frame]()
    for k in range(2000):
        bench.us = 1000 * (k + 1)
        frame = Frame()
        alive.add(frame)
        bench.queue.put(frame, 1000 + k % 7)
        del frame
        if k % 3 == 0:
            bench.take()
            bench.us += 500
            if bench.queue.in_flight:
                bench.queue.gone()
            bench.take()
    gc.collect()
    assert len(alive) <= 4 + 1
    assert bench.queue._row.room == 64
    assert replay(bench.records).differences == ()


def test_what_breaks_the_rules_is_refused() -> None:
    """Messages that cannot be put, a message gone that was not returned, and policies that see too much."""
    bench = Bench()
    bench.put(10, x=1.0)
    for rule, settings in (
        ("size_bytes = 0", {"size_bytes": 0}),
        ("size_bytes = 1.5", {"size_bytes": 1.5}),
        ("x = nan", {"x": math.nan}),
        ("not less than 1.0", {"x": 0.5}),
        ("topic = -1", {"topic": -1}),
        ("at_us = -1", {"at_us": -1}),
    ):
        refuse(rule, bench.queue.put, "message", **{"size_bytes": 1, **settings})
        bench.put(20, x=1.0)  # nothing happened
        assert replay(bench.records).differences == ()
    refuse("returned", bench.queue.gone)
    for name in policies.names():
        if not policies.get(name).ranked:
            refuse("live queue", PolicyQueue, name, 4)


def test_a_policy_that_raises_an_error_ends_its_queue() -> None:
    def breaks(buffer: Any, arrival: Any, memory: Any) -> int:
        "A full queue is too much for it."
        if len(buffer.slots) == buffer.capacity:
            raise ZeroDivisionError
        return policies.ACCEPT

    bench = Bench(Policy("breaks", breaks), 1)
    bench.put(10)
    bench.put(20)
    with pytest.raises(ZeroDivisionError):
        bench.put(30)
    item = bench.queue.get()
    assert item is not None and item.seq == 0
    assert bench.queue.get() is None
    refuse("closed", bench.put, 40)
