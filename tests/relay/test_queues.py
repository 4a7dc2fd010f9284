"""What waits for a subscriber, and that a slow one slows nobody."""

import pytest
from refusal_cases import refuse
from relay_cases import Corner, Server, relay, settings

from bufgym.ground.errors import BufgymError
from bufgym.relay import policies
from bufgym.relay.config import POLICIES, Config
from bufgym.relay.patterns import MAX_CHARACTERS, pattern
from bufgym.relay.quota import Bucket, Quotas
from bufgym.relay.subscriber import Subscription, next_lane


def subscription(policy: str, capacity: int = 8, priority: float = 1.0) -> Subscription:
    return Subscription("a", pattern(".*"), policies.policy(policy), capacity, priority=priority)


def sent(*subscriptions: Subscription, now_s: float = 0.0) -> list[object]:
    """All that goes, one after the other, a second for each."""
    went = []
    while (lane := next_lane(subscriptions, now_s)) is not None:
        item = lane.take(now_s)
        assert item is not None
        went.append(item.message)
        lane.gone()
        now_s += 1
    return went


WENT = {"drop-oldest": "034", "drop-newest": "012", "robofleet": "04", "skip-pending": "0"}
"""Of messages 0 to 4: the first is on its way at once; then the queue has room for two."""


@pytest.mark.parametrize(("policy", "went"), WENT.items())
def test_the_policy_decides(policy: str, went: str) -> None:
    one = subscription(policy, 2)
    for k in range(5):
        one.offer("/a", str(k), 10)
    assert len(one) == len(went) - 1 and one.dropped == 5 - len(went)
    assert sent(one) == list(went)
    one.offer("/a", "5", 10)
    assert sent(one) == ["5"]


@pytest.mark.parametrize("policy", POLICIES)
def test_each_policy_of_the_default_serves_several_topics(policy: str) -> None:
    one = subscription(policy)
    for k in range(3):
        for topic in "ab":
            one.offer(f"/{topic}", f"{topic}{k}", 10)
    went = sent(one)
    assert {str(message)[0] for message in went} >= ({"a"} if policy == "skip-pending" else {"a", "b"})
    assert len(went) + one.dropped == 6


def test_topics_of_a_policy_that_knows_none_do_not_push_each_other_out() -> None:
    one = subscription("drop-oldest", 1)
    one.offer("/rare", "rare", 10)
    one.offer("/rare", "rare 2", 10)
    for k in range(100):
        one.offer("/often", k, 10)
    assert sorted(map(str, sent(one))) == ["0", "99", "rare", "rare 2"]


def test_priority_times_wait() -> None:
    """At second 0 both wait equally long: the first goes. Then 10 x 1 s is more than 1 x 2 s, and so on."""
    low, high = subscription("drop-oldest"), subscription("drop-oldest", priority=10)
    for k in range(3):
        low.offer("/low", f"low {k}", 10)
        high.offer("/high", f"high {k}", 10)
    assert sent(low, high, now_s=100) == ["high 0", "low 0", "high 1", "high 2", "low 1", "low 2"]


def test_queues_and_topics_are_bounded() -> None:
    one = subscription("skip-pending")
    for k in range(200):
        one.offer(f"/{k}", k, 10)
    assert len(one.lanes) == 64 and len(one._topics) == 64


async def test_a_subscriber_that_reads_nothing_slows_nobody(corner: Corner) -> None:
    topic, before = corner.topic("camera"), corner.hub.status()["dropped"]
    async with corner.client() as robot, corner.client() as fast, corner.client(receive_buffer_bytes=16_384) as stuck:
        for one in (fast, stuck):
            await one.subscribe(f"^{topic}$", policy="robofleet")
        stuck.socket.transport.pause_reading()
        for k in range(20):
            await robot.put(topic, bytes(100_000), seq=k)
            assert (await fast.next()).seq == k
        dropped = corner.hub.status()["dropped"] - before
        assert dropped > 10
        stuck.socket.transport.resume_reading()
        # What the system had taken, and then the newest alone.
        numbers = [message.seq for message in await stuck.rest()]
        assert numbers == sorted(set(numbers)) and numbers[-1] == 19 and len(numbers) == 20 - dropped


def test_patterns_of_strangers_take_linear_time() -> None:
    evil = pattern("(a+)+$")
    assert evil.part("/" + "a" * 200) and not evil.part("/" + "a" * 200 + "b")
    assert pattern("^/a$").part("/a") and not pattern("^/a$").part("/ab")
    assert pattern("/a").part("x/ab") and not pattern("/a").whole("x/ab")
    for text in ("(", "a" * (MAX_CHARACTERS + 1), r"(a)\1", r"\pL{500}", "\ud800"):
        refuse("pattern", pattern, text)


def test_a_bucket_of_ten_a_second() -> None:
    bucket = Bucket(10)
    assert [bucket.take(4, 0.0) for _ in range(3)] == [True, True, False]
    assert not bucket.take(4, 0.1) and bucket.take(4, 0.2)  # 2 left, 3, 4
    # More than a second's worth waits for a full bucket, and is paid for.
    assert bucket.take(25, 5.0) and not bucket.take(1, 6.5) and bucket.take(1, 6.7)


def test_quotas_are_remembered_for_a_while() -> None:
    now_s = 0.0
    quotas = Quotas(Config().limits, lambda: now_s)
    with quotas.connection("a", {}) as quota:
        now_s = 100.0
        quotas.tidy()
        assert quotas.of("a") is quota
    quotas.tidy()
    assert quotas.of("a") is quota
    now_s = 161.0
    quotas.tidy()
    assert quotas.of("a") is not quota


async def test_a_port_that_is_taken() -> None:
    async with relay() as server:
        other = Server(settings(port=server.port))
        with pytest.raises(BufgymError, match=r"127\.0\.0\.1"):
            await other.start()
        await other.close()
