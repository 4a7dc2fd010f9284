"""A policy only reads what it sees: in Python a write is refused, compiled ones are found out after the run."""

from typing import Any

import numpy as np
import pytest
from refusal_cases import refuse

from bufgym import scenario
from bufgym.benchmark import run as bench
from bufgym.benchmark.tasks.queue import QueueTask
from bufgym.envs import SenderEnv
from bufgym.envs.expert import Player
from bufgym.kernels.source import generated
from bufgym.model import qoi
from bufgym.model.link import Link
from bufgym.model.topics import Topic
from bufgym.policies import ACCEPT, Policy, get
from bufgym.scenario import Episode, FleetEpisode, Streams, Uplink, messages
from bufgym.sim import Senders, audit, run
from bufgym.sim.cell import run_fleet
from bufgym.sim.state import NEVER
from bufgym.traces import Trace
from bufgym.utils.errors import BufgymError

V = qoi.exponential()
EPISODE = Episode(messages(np.arange(40) * 1_000, 4_000), Link(Trace.constant(1e6, 10)))

WRITES = {
    "buffer.slots[0].seq = buffer.slots[len(buffer.slots) - 1].seq": audit.FAULTS[audit.LOG],
    "buffer.slots[0].seq = 10**9": audit.FAULTS[audit.LOG],
    "arrival.seq = -(10**9)": audit.FAULTS[audit.ARRIVAL],
    "buffer.slots[len(buffer.slots) - 1].x -= 0.5": audit.FAULTS[audit.QOI],
    "buffer.slots[len(buffer.slots) - 1].gain = 1.0": audit.FAULTS[audit.QOI],
    "arrival.x *= 1000": audit.FAULTS[audit.ARRIVAL],
    "arrival.size_bytes = 1": audit.FAULTS[audit.ARRIVAL],
    "buffer.slots[0].size_bytes = 1": audit.FAULTS[audit.BYTES],
    "buffer.topics[0].limit = 10**6": audit.FAULTS[audit.TOPIC],
}
"""What a policy writes, and what is said of it."""


def writer(write: str, **options: Any) -> Policy:
    made: dict[str, Any] = {"__name__": __name__}
    accept = "return -2 if len(buffer.slots) < buffer.capacity else 0"
    queued = "True" if write.startswith("arrival") else "len(buffer.slots) > 0"
    text = f"def on_arrival(buffer, arrival, memory):\n if {queued}: {write}\n {accept}"
    exec(compile(text, generated(text), "exec"), made)
    return Policy("test-writer", made["on_arrival"], **options)


def honest(buffer: Any, arrival: Any, memory: Any) -> int:
    return ACCEPT if len(buffer.slots) < buffer.capacity else 0


@pytest.mark.parametrize("write", WRITES)
def test_a_python_policy_cannot_write(write: str) -> None:
    with pytest.raises(ValueError, match="read-only"):
        run(writer(write), [EPISODE], 3, V)
    env, player = (
        SenderEnv(Uplink(traces=(EPISODE.link.trace,), size_bytes=200_000), 3, actions="slots"),
        Player(writer(write)),
    )
    env.reset(seed=0)
    with pytest.raises(ValueError, match="read-only"):
        for _ in range(9):
            env.step(player.action(env.sub_envs.senders))


@pytest.mark.parametrize("write", WRITES)
def test_a_compiled_policy_that_writes_has_no_result(write: str) -> None:
    policy = writer(write, compile=True)
    fault = f"policy test-writer: wrote to what it may only read: {WRITES[write]}|read-only"  # that without a compiler
    with pytest.raises((BufgymError, ValueError), match=fault):
        run(policy, [EPISODE], 3, V)
    with pytest.raises((BufgymError, ValueError), match=fault):
        run_fleet(policy, [FleetEpisode((EPISODE.arrivals,) * 2, EPISODE.link)], 3, V)


def two_topics(period_us: int) -> Episode:
    arrivals = messages(np.arange(40) * period_us, 4_000)
    arrivals["topic"] = np.arange(40) % 2
    return Episode(arrivals, EPISODE.link)


def test_a_python_policy_cannot_write_to_the_rules_of_several_topics() -> None:
    rules = [Topic("a", limit=1), Topic("b", limit=1)]
    with pytest.raises(ValueError, match="read-only"):
        run(writer("buffer.topics[0].limit = 10**6"), [two_topics(1_000)], 3, V, topics=rules)


def test_h_of_several_topics_is_added_up_again() -> None:
    """As honest as it was run, the sum stands; with anything added it does not."""
    rules, policy = [Topic("a", weight=2.0), Topic("b", value=qoi.saturating(4))], Policy("test-honest", honest)
    senders = run(policy, [two_topics(10_000)], 3, V, topics=rules)
    senders.check_untouched(policy)
    senders.batch.senders["delivered_gain"] += 1e-3
    refuse(audit.FAULTS[audit.QOI], senders.check_untouched, policy)


def test_a_row_above_the_clairvoyant_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """Were the bound a hundredth lower than what Drop Oldest reaches, a benchmark would say so and stop."""
    best = QueueTask.play

    def lowered(self: Any, policies: Any, *rest: Any) -> Any:
        for results in best(self, policies, *rest):
            yield [[{**row, "clairvoyant": 0.99 * row["qoi"]} for row in rows] for rows in results]

    monkeypatch.setattr(QueueTask, "play", lowered)
    fault = r"^policy drop-oldest, L = 4, trace constant, seed 3: H = \S+ is above \S+, which no policy can reach$"
    refuse(fault, bench.run, [get("drop-oldest")], Uplink(traces=(EPISODE.link.trace,), duration_s=3), [4], [3])


def test_honest_policies_are_not_accused() -> None:
    """Among them one that drops at the head, and a link that ends with messages queued and in the socket."""
    lte = scenario.get("lte")
    episodes = [lte.draw(Streams.seeded(seed)) for seed in range(3)]
    ends = Link(Trace("ends", np.array([0, 20_000]), np.array([0, 20_000]), after="stop"))
    episodes.append(Episode(messages(np.arange(40) * 1_000, 4_000), ends))
    for name in ("drop-oldest", "codel", "afr", "random", "drop-newest"):
        run(get(name), episodes, 5, lte.value).check_untouched(get(name))


def finished() -> Senders:
    """L = 2, a byte a us for 20 us, messages of 10 bytes: 0 and 2 are sent, 3 not all, 4 and 5 wait, 1 is dropped."""
    ends = Trace("ends", np.array([0, 20]), np.array([0, 20]), after="stop")
    episode = Episode(messages(np.array([0, 1, 2, 3, 15, 25]), 10), Link(ends))
    senders = Senders(1, 2, V, max_messages=6)
    senders.load(0, episode)
    senders.run(get("drop-oldest"))
    return senders


FIELDS = ("seq", "arrival_us", "size_bytes", "topic", "x", "uniform")
RULES = ("priority", "weight", "period_us", "limit", "no_drop", "deadline_us", "v_start")
COUNTS = ("dequeued", "evicted", "rejected", "next")
FORGERIES = [
    *((audit.ARRIVAL, "arrivals", field, k, 1) for field in FIELDS for k in (0, 5)),
    *((audit.QUEUED, "slots", field, k, 1) for field in FIELDS for k in (2, 3)),
    *((audit.QUEUED, "slots", "seq", k, amount) for k, amount in ((2, -100), (3, 100))),
    *((audit.QUEUED, "log", field, k, 40) for field in ("dequeued_us", "dropped_us") for k in (4, 5)),
    *((audit.BYTES, "senders", "backlog_bytes", 0, amount) for amount in (1, -1)),
    (audit.LOG, "log", "dropped_us", 0, 7),  # was sent
    (audit.LOG, "log", "dropped_us", 1, NEVER),  # was not sent either
    (audit.LOG, "log", "dequeued_us", 2, 1),  # came at 2
    *((audit.LOG, "senders", field, 0, amount) for field in COUNTS for amount in (1, -1)),
    *((audit.TOPIC, "topics", field, 0, 1) for field in RULES),
    *((audit.QOI, "senders", "delivered_gain", 0, amount) for amount in (1e-6, -1e-6)),
    (0, "senders", "delivered_gain", 0, 1e-10),  # rounding
]
"""What is found, and what was written: a time into the log, or something added to the k-th entry of a table."""


@pytest.mark.kernels
def test_a_run_is_searched_for_everything_a_policy_may_not_write() -> None:
    for finding, table, field, k, amount in FORGERIES:
        senders = finished()
        given = senders.batch, 0, senders.episodes[0], senders.topic_table
        assert audit.touched(*given) == ""
        rows = np.asarray(getattr(senders.batch, table))
        entries = (rows if table == "senders" else rows[0])[field]
        entries[k] = amount if table == "log" else entries[k] + amount
        assert audit.touched(*given) == audit.FAULTS[finding], (table, field, k, amount)
    senders = finished()
    senders.batch.slots[0, 3] = senders.batch.slots[0, 2]  # one message twice
    assert audit.touched(senders.batch, 0, senders.episodes[0], senders.topic_table) == audit.FAULTS[audit.QUEUED]
